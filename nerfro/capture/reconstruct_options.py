"""What `python -m nerfro.reconstruct` can be asked, and what its stages are told of each other's results."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

from omegaconf import MISSING, DictConfig, OmegaConf

from nerfro.allowed import Count
from nerfro.capture.preprocess_options import is_given
from nerfro.cli import warn
from nerfro.errors import NerfroError
from nerfro.files.reading import read_json


@dataclass
class ReconstructConfig:
    """What `python -m nerfro.reconstruct` is asked.

    Attributes:
        data: instead of `images`, views that have poses (options of the group `data`, which all stages are given).
        medium: what becomes of the surface (options of the group `medium`).
        images: folder of photographs without poses.
        masks: folder of their masks, `<photograph>.png` or `mask_<photograph>.png`.
        outlines: of the object in some photographs, as `python -m nerfro.mask` takes them.
        out: folder that everything is written to.
        pixels: the longer side of the photographs in training, at most; `data.downscale` has precedence.
        calibrate, mask, preprocess, train: more options of these stages, as they are typed on a command line.
    """

    data: Any = MISSING
    medium: Any = MISSING
    images: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    masks: Optional[str] = None  # noqa: UP045
    outlines: Any = None
    out: Optional[str] = None  # noqa: UP045
    pixels: Count = 256
    calibrate: str = ""
    mask: str = ""
    preprocess: str = ""
    train: str = ""


def have_poses(config: DictConfig, overrides: list[str]) -> bool:
    """Whether the photographs have poses; what contradicts itself is refused."""
    posed = config.images is None
    if config.out is None or (posed and OmegaConf.is_missing(config.data, "root")):
        raise NerfroError("set out=FOLDER, and images=PHOTOS or, where they have poses, data=FORMAT data.root=FOLDER")
    if not posed and (is_given("data", overrides) or is_given("data.root", overrides)):
        raise NerfroError("images= are photographs without poses, data= and data.root= such with poses; give one")
    if posed and config.masks is not None:
        raise NerfroError("masks= belongs to images=; the masks of data.root= lie in it, as docs/data.md tells")
    return posed


def of_groups(names: tuple[str, ...], overrides: list[str]) -> list[str]:
    """The overrides of some groups or settings."""
    return [text for text in overrides if text.lstrip("+").split("=")[0].split(".")[0] in names]


def training_options(config: DictConfig, overrides: list[str], surface: Path) -> list[str]:
    """Options that train on a surface, by what `preprocess` has found.

    Args:
        config, overrides: of this command line.
        surface: the file that tells it.
    """
    found, extra = read_result(surface, {"options", "doubtful", "near", "pixels"}), shlex.split(config.train)
    if found["doubtful"]:
        warn(f"{' '.join(found['doubtful'])} fits best, but the photographs do not tell for sure; see {surface.parent}")
    options = [*found["options"], *found["doubtful"]]
    if not is_given("experiment", extra):
        # A vessel's materials are known. In a room, following all reflections and learning the index cost more than
        # they win in the same time (docs/real.md).
        far = "glass" if "wall" in config.medium else "unknown"
        options.insert(0, f"+experiment={'glass_room' if found['near'] else far}")
    if not is_given("camera.exposure", extra):
        options.append("camera.exposure=true")  # telephones choose one for each photograph
    if not is_given("data.downscale", overrides):
        options.append(f"data.downscale={max(1.0, max(found['pixels']) / config.pixels):.4g}")
    return [*options, *extra]


def read_result(file: Path, keys: set[str]) -> dict[str, Any]:
    """A stage's result, which somebody may have corrected."""
    advice = "delete it to have it made again"
    result = read_json(file, advice)
    if not isinstance(result, dict) or not keys <= result.keys():
        raise NerfroError(f"{file} lacks one of {', '.join(sorted(keys))}; {advice}")
    return result
