"""From photographs and a surface to the medium, whose index is searched for where it is not known."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig

from nerfro.capture.index_report import CURVE, INDEX, search_index
from nerfro.capture.preprocess_options import build_medium, index_settings, searches_index
from nerfro.capture.surroundings import Around
from nerfro.errors import NerfroError
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.solid import Solid


@dataclass
class FoundMedium:
    """A medium, and what its search has told.

    Attributes:
        medium: with all numbers that were found.
        settings: options that say them; not those that are doubtful.
        doubtful: options that the pictures do not tell, with what fits best.
        written: names of the files.
    """

    medium: Medium
    settings: dict[str, object] = field(default_factory=dict)
    doubtful: dict[str, object] = field(default_factory=dict)
    written: list[str] = field(default_factory=list)


def refinable(found: FoundMedium) -> SdfGrid:
    """The medium, if its surface can be refined.

    Raises:
        NerfroError: it cannot, and why.
    """
    if found.doubtful:
        option = next(iter(found.doubtful))
        raise NerfroError(f"refine=true needs the index, and the pictures do not tell it; give {option}=N")
    return cast(SdfGrid, found.medium)


def find_medium(
    config: DictConfig,
    overrides: list[str],
    around: Around,
    location: str,
    settings: dict[str, object],
    folder: Path,
) -> FoundMedium:
    """The medium with a surface in it, and with the index where that is searched for.

    Args:
        config, overrides: of this command line.
        around: what photographs show around the surface and through it.
        location: of the surface's file.
        settings: what has to be said beside the overrides, so that the medium holds the surface.
        folder: to write to.
    """
    if not searches_index(config, overrides):
        return FoundMedium(build_medium(config, settings, location, {}))
    num_bodies = 1 + len(config.medium.get("inner_meshes", []))
    medium = build_medium(config, settings, location, index_settings([1.5] * num_bodies))
    if not isinstance(medium, Solid):
        raise NerfroError("the index of this medium is not searched for; give medium.ior=, or take medium=object")
    found = search_index(around, medium, folder)
    options: dict[str, object] = {
        f"medium.{name}": value for name, value in index_settings(found.values.tolist()).items()
    }
    return FoundMedium(
        medium.with_indices(torch.from_numpy(found.values)),
        settings={} if found.doubts else options,
        doubtful=options if found.doubts else {},
        written=[INDEX, CURVE],
    )
