"""Construction of the medium from a surface, with a search for unknown refractive indices."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from nerfro.capture.index_report import search_index
from nerfro.capture.preprocess_options import Request, build_medium, index_settings
from nerfro.capture.surroundings import Observations
from nerfro.errors import NerfroError
from nerfro.media.base import Medium
from nerfro.media.solid import Solid


@dataclass(frozen=True)
class FoundMedium:
    """A medium with all indices.

    Attributes:
        medium: the medium.
        index_settings: options of the indices that were searched.
        is_doubtful: whether the photographs do not determine these indices.
    """

    medium: Medium
    index_settings: dict[str, object] = field(default_factory=dict)
    is_doubtful: bool = False


def find_medium(
    request: Request, observations: Observations, location: str, settings: dict[str, object]
) -> FoundMedium:
    """Build the medium with a surface, and search the indices if they are not given.

    Args:
        request: options of the command.
        observations: observations of the object and its surroundings.
        location: file of the surface.
        settings: options of the surface (see `surface_settings`).
    """
    if not request.searches_index:
        return FoundMedium(build_medium(request, settings, location, {}))
    num_bodies = 1 + len(request.config.medium.get("inner_meshes", []))
    medium = build_medium(request, settings, location, index_settings([1.5] * num_bodies))
    if not isinstance(medium, Solid):
        raise NerfroError("the index of this type of medium cannot be searched for; set medium.ior=, or medium=object")
    found = search_index(observations, medium, request.folder)
    options: dict[str, object] = {f"medium.{name}": value for name, value in index_settings(found.values).items()}
    return FoundMedium(medium.with_indices(torch.from_numpy(found.values)), options, bool(found.doubts))
