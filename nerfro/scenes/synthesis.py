"""Rendering the pictures of a synthetic scene that a folder lacks."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Optional

from omegaconf import MISSING, DictConfig, OmegaConf
from tqdm import tqdm

from nerfro.errors import NerfroError
from nerfro.paths import user_path
from nerfro.scenes import SCENES, dataset
from nerfro.scenes.path_tracer import PathTracer, load_mitsuba
from nerfro.scenes.scene import Scene

CAPTURES = ("dolphin_capture",)


@dataclass
class ViewCounts:
    """Number of views per split."""

    train: int = MISSING
    val: int = MISSING
    test: int = MISSING


@dataclass
class SynthesizeConfig:
    """Options of `nerfro.synthesize`; conf/synthesize/synthesize.yaml gives and explains the defaults."""

    scene: str = MISSING
    out: str = MISSING
    resolution: int = MISSING
    spp: int = MISSING
    test_spp: int = MISSING
    views: ViewCounts = field(default_factory=ViewCounts)
    photographs: int = MISSING
    noise: float = MISSING
    fresnel: bool = MISSING
    absorption: list[float] = MISSING
    ior: Optional[float] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    seed: int = MISSING
    sky_height: int = MISSING
    extras: bool = MISSING
    variant: str = MISSING
    overwrite: bool = MISSING


def build_scene(name: str, resolution: int) -> Scene:
    """Model a scene, with colours as fine as half a pixel of pictures that are `resolution` pixels wide.

    Raises:
        NerfroError: no such scene.
    """
    if name not in SCENES + CAPTURES:
        raise NerfroError(f"unknown scene '{name}'; choose one of {', '.join(SCENES + CAPTURES)}")
    if name in CAPTURES:
        pixel = dataset.PHOTOGRAPHER_DISTANCE / (dataset.FOCAL * resolution)
    else:
        pixel = dataset.CAMERA_DISTANCE * dataset.CAMERA_ANGLE_X / resolution
    return importlib.import_module(f"nerfro.scenes.{name}").build(spacing=max(0.5 * pixel, 0.0025))


def synthesize(config: DictConfig) -> tuple[Scene, Path]:
    """Render what is missing of a data set; return the scene and the folder.

    Args:
        config: resolved `SynthesizeConfig`.

    Raises:
        NerfroError: an option is out of range, Mitsuba is missing, or `out` holds something else.
    """
    lowest = {"resolution": 8, "spp": 1, "test_spp": 1, "seed": 0, "sky_height": 16, "photographs": 1, "noise": 0}
    for name, least in (lowest | {f"views.{split}": 1 for split in dataset.SPLITS}).items():
        value = OmegaConf.select(config, name)
        if value < least:
            raise NerfroError(f"{name}={value} is too small; give {least} or more")
    absorption = tuple(config.absorption)
    if len(absorption) != 3 or not all(0 <= value < float("inf") for value in absorption):
        raise NerfroError(f"absorption={list(absorption)} is not allowed; give red, green and blue, at least 0 each")
    if config.ior is not None and not config.ior > 0:
        raise NerfroError(f"ior={config.ior} is no refractive index; give a positive number, or none for the scene's")
    scene, folder = build_scene(config.scene, config.resolution), user_path(config.out)
    scene = replace(scene, absorption=absorption, ior=scene.ior if config.ior is None else config.ior)
    mitsuba = load_mitsuba(config.variant)  # before anything is cleared that could not be rendered again
    data = (dataset.Photographs if config.scene in CAPTURES else dataset.Views)(config, scene, folder)
    data.prepare(mitsuba)
    planned = data.planned()
    waiting = data.missing(planned)
    print(f"{config.scene}: {len(planned)} {data.THINGS}, {len(planned) - len(waiting)} of them already in {folder}")
    if waiting:
        tracer = PathTracer(data.lit(), config.fresnel, data.camera, config.variant)
        # The estimate counts samples, not pictures: test views have more of them.
        with tqdm(total=sum(picture.spp for picture in waiting), unit="spp", desc="render", dynamic_ncols=True) as bar:
            for picture in waiting:
                radiance = tracer.render(picture.pose, picture.spp, picture.seed)
                data.write(picture, radiance, tracer.silhouette(picture.pose))
                bar.update(picture.spp)
    data.finish(planned)
    return scene, folder
