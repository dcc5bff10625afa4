"""Options of `python -m nerfro.reconstruct`, and the options that each stage receives from earlier results."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from omegaconf import MISSING, DictConfig

from nerfro.capture.preprocess_options import PreprocessConfig
from nerfro.cli.options import describe, recall
from nerfro.cli.overrides import full_key, is_given
from nerfro.core.errors import NerfroError
from nerfro.masks.options import MaskConfig
from nerfro.poses.options import CalibrateConfig
from nerfro.registry.allowed import Count, Natural
from nerfro.training.config import TrainConfig

# Stages with options of their own, and the dataclasses of these options.
STAGES = {"calibrate": CalibrateConfig, "mask": MaskConfig, "preprocess": PreprocessConfig, "train": TrainConfig}


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


def stage_options(stage: str, config: DictConfig) -> list[str]:
    """Return the further options of a stage.

    Raises:
        NerfroError: a quotation mark is not closed.
    """
    try:
        return shlex.split(config[stage])
    except ValueError:
        raise NerfroError(
            f"{stage}={config[stage]!r} has a quotation mark that is not closed, or ends with a backslash"
        ) from None


def have_poses(config: DictConfig, overrides: list[str]) -> bool:
    """Check the options, and return whether the photographs have poses.

    Raises:
        NerfroError: options are missing, contradict each other, or are flags for a stage or unknown to it.
    """
    for stage, schema in STAGES.items():
        options = stage_options(stage, config)
        for option in options:
            if option.startswith("-"):
                raise NerfroError(
                    f"{stage}={config[stage]!r}: {option} is a flag; give options of the form key=value, which "
                    f"`nerfro {stage} --help` explains"
                )
        if options:
            described = recall(stage) or describe(stage, schema)
            described.require_known([full_key(option) for option in options])
    if config.hypothesis is not None and is_given("experiment", stage_options("train", config)):
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
    extra = stage_options("train", config)
    # Telephones select an exposure for each photograph.
    options = [] if is_given("camera.exposure", extra) else ["camera.exposure=true"]
    if photograph and not is_given("data.downscale", overrides):
        options.append(f"data.downscale={max(1.0, max(photograph) / config.pixels):.4g}")
    return [*options, *extra]
