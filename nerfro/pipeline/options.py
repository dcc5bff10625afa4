"""Options of `python -m nerfro.reconstruct`, and the options that each stage receives from earlier results."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from omegaconf import MISSING, DictConfig

from nerfro.cli.overrides import is_given
from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import Count, Natural


@dataclass
class ReconstructConfig:
    """Options of `python -m nerfro.reconstruct`.

    Attributes:
        data: data set with poses, instead of `images` or `video` (options of the group `data`, passed to all stages).
        medium: medium that is built from the surface (options of the group `medium`).
        images: folder of photographs without poses.
        video: video instead of photographs; the sharpest of its frames are used.
        frames: number of frames to take from the video.
        masks: folder of the masks, PNG or JPEG files named `<photograph>` or `mask_<photograph>`.
        outlines: boxes or polygons around the object in some photographs, as for `python -m nerfro.mask`.
        out: output folder.
        hypothesis: assumption about the object: `straight` rays, a `solid` body (or the bodies that the medium
            describes) or a `vessel`; by default, trials decide. If the photographs do not determine the index of a
            solid body, trials decide between water and glass. An earlier run with another hypothesis is renamed.
        trial_steps: number of steps of the training that tries each hypothesis about the object on validation
            photographs (straight rays, solid body, vessel); 0 skips the comparison and trains with bent rays: of
            the vessel or the bodies that the medium of the scene file describes, otherwise of a solid body (of water,
            if its index is unknown).
        pixels: maximum length of the longer side of the photographs in training; `data.downscale` has precedence.
        calibrate: further options of `python -m nerfro.calibrate`, separated by spaces.
        mask: further options of `python -m nerfro.mask`: `view=true` opens a page for drawing outlines, and
            `sam2=FOLDER` follows the outlined object through the photographs by a network.
        preprocess: further options of `python -m nerfro.preprocess`.
        train: further options of the final `python -m nerfro.train` and of the trials. With an experiment, as in
            `train='+experiment=glass_room medium=vessel'`, hypotheses are not compared.
    """

    data: Any = MISSING
    medium: Any = MISSING
    images: str | None = None
    video: str | None = None
    frames: Annotated[int, Ge(3), Le(1000)] = 60
    masks: str | None = None
    outlines: Any = None
    out: str | None = None
    hypothesis: Literal["straight", "solid", "vessel"] | None = None
    trial_steps: Natural = 600
    pixels: Count = 256
    calibrate: str = ""
    mask: str = ""
    preprocess: str = ""
    train: str = ""


def have_poses(config: DictConfig, overrides: list[str]) -> bool:
    """Check the options, and return whether the photographs have poses.

    Raises:
        NerfroError: options are missing, contradict each other, or are flags for a stage.
    """
    for stage in ("calibrate", "mask", "preprocess", "train"):
        for option in shlex.split(config[stage]):
            if option.startswith("-"):
                raise NerfroError(
                    f"{stage}={config[stage]!r}: {option} is a flag; give options of the form key=value, which "
                    f"`nerfro {stage} --help` explains"
                )
    if config.hypothesis is not None and is_given("experiment", shlex.split(config.train)):
        raise NerfroError(
            f"hypothesis={config.hypothesis} and the experiment in train={config.train!r} both determine the training; "
            "give one of the two"
        )
    if config.images is not None and config.video is not None:
        raise NerfroError("images= and video= are both given; give one of the two")
    posed = config.images is None and config.video is None
    if config.out is None or (posed and not is_given("data.root", overrides)):
        raise NerfroError(
            "set out=FOLDER, and images=PHOTOS, video=FILE or, for images with poses, data=FORMAT data.root=FOLDER"
        )
    if not posed and (is_given("data", overrides) or is_given("data.root", overrides)):
        raise NerfroError(
            "images= and video= are for photographs without poses, and data= and data.root= are for photographs with "
            "poses; give one of the two"
        )
    if posed and config.masks is not None:
        raise NerfroError("masks= needs images=; for a data set with poses, put the masks into the folder data.root=")
    return posed


def common_options(config: DictConfig, overrides: list[str], photograph: Sequence[int]) -> list[str]:
    """Determine the options of the training that do not depend on the assumptions about the object.

    Args:
        config: options of the command.
        overrides: the command line.
        photograph: width and height of the photographs, in pixels; empty if unknown.
    """
    extra = shlex.split(config.train)
    # Telephones select an exposure for each photograph.
    options = [] if is_given("camera.exposure", extra) else ["camera.exposure=true"]
    if photograph and not is_given("data.downscale", overrides):
        options.append(f"data.downscale={max(1.0, max(photograph) / config.pixels):.4g}")
    return [*options, *extra]
