"""Rendering the pictures of a synthetic scene that a folder lacks."""

from __future__ import annotations

import importlib
import importlib.metadata
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from omegaconf import MISSING, DictConfig
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nerfro.errors import NerfroError
from nerfro.files.lat_long import save_lat_long
from nerfro.light import to_srgb
from nerfro.paths import user_path
from nerfro.scenes import SCENES, dataset, photographs
from nerfro.scenes.baking import bake
from nerfro.scenes.path_tracer import PathTracer, Pinhole, load_mitsuba
from nerfro.scenes.scene import Scene
from nerfro.scenes.skies import lat_long_texture

CAPTURES = ("dolphin_capture",)
_BAKING_SPP = 256


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
    seed: int = MISSING
    sky_height: int = MISSING
    extras: bool = MISSING
    variant: str = MISSING
    overwrite: bool = MISSING


def build_scene(name: str, resolution: int) -> Scene:
    """Model a scene, with colours as fine as half a pixel of the picture that it is meant for.

    Args:
        name: one of `SCENES` or `CAPTURES`.
        resolution: width of the pictures, pixels.

    Raises:
        NerfroError: no such scene.
    """
    if name not in SCENES + CAPTURES:
        raise NerfroError(f"unknown scene '{name}'; choose one of {', '.join(SCENES + CAPTURES)}")
    if name in CAPTURES:
        pixel = photographs.DISTANCE / photographs.camera(resolution).focal
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
    _check(config)
    scene = build_scene(config.scene, config.resolution)
    folder = user_path(config.out)
    mitsuba = load_mitsuba(config.variant)  # before anything is cleared that could not be rendered again
    write = _photograph if config.scene in CAPTURES else _render_views
    write(config, scene, folder, mitsuba)
    return scene, folder


def _render_views(config: DictConfig, scene: Scene, folder: Path, mitsuba: ModuleType) -> None:
    settings = dataset.Settings(
        scene=config.scene,
        fingerprint=dataset.fingerprint(scene),
        resolution=config.resolution,
        spp=config.spp,
        test_spp=config.test_spp,
        views={split: config.views[split] for split in dataset.SPLITS},
        fresnel=config.fresnel,
        seed=config.seed,
    )
    dataset.prepare(folder, settings, config.overwrite)
    if not (folder / dataset.META).is_file():
        dataset.write_meta(folder, settings, scene, _versions(mitsuba))
    planned = dataset.views(settings)
    waiting = list(dataset.missing(folder, planned))
    print(f"{config.scene}: {len(planned)} views, {len(planned) - len(waiting)} of them already in {folder}")
    if waiting:
        camera = Pinhole.square(dataset.CAMERA_ANGLE_X, config.resolution)
        tracer = PathTracer(scene, config.fresnel, camera, variant=config.variant)
        _render(tracer, waiting, lambda view, *pictures: dataset.write_view(folder, view, *pictures))
    scene.glass.save(folder / "mesh.ply")
    assert scene.sky is not None
    sky = lat_long_texture(scene.sky, config.sky_height)
    dataset.write_image(folder / "sky.png", to_srgb(sky))
    if config.extras:
        scene.interior.save(folder / "interior.ply")
        save_lat_long(folder / "sky.exr", torch.from_numpy(sky))
    dataset.write_transforms(folder, planned)


def _photograph(config: DictConfig, scene: Scene, folder: Path, mitsuba: ModuleType) -> None:
    settings = photographs.Settings(
        scene=config.scene,
        fingerprint=dataset.fingerprint(scene),
        resolution=config.resolution,
        photographs=config.photographs,
        spp=config.spp,
        noise=config.noise,
        fresnel=config.fresnel,
        seed=config.seed,
    )
    dataset.prepare(folder, settings, config.overwrite, photographs.META, photographs.FILES)
    if not (folder / photographs.META).is_file():
        photographs.write_meta(folder, settings, scene, _versions(mitsuba))
    planned = photographs.photographs(settings, importlib.import_module(f"nerfro.scenes.{config.scene}").AIM)
    waiting = list(dataset.missing(folder, planned))
    print(f"{config.scene}: {len(planned)} photographs, {len(planned) - len(waiting)} of them already in {folder}")
    if waiting:
        lit = bake(scene, _BAKING_SPP, config.variant)
        tracer = PathTracer(lit, config.fresnel, photographs.camera(config.resolution), variant=config.variant)
        _render(
            tracer,
            waiting,
            lambda taken, radiance, mask: photographs.write_photograph(folder, taken, radiance, mask, config.noise),
        )
    photographs.write_truth(folder, planned, settings, scene)


def _check(config: DictConfig) -> None:
    lowest = {"resolution": 8, "spp": 1, "test_spp": 1, "seed": 0, "sky_height": 16, "photographs": 1, "noise": 0}
    for name, least in lowest.items():
        if config[name] < least:
            raise NerfroError(f"{name}={config[name]} is too small; give {least} or more")
    for split in dataset.SPLITS:
        if config.views[split] < 1:
            raise NerfroError(f"views.{split}={config.views[split]} is too small; give 1 or more")


def _render(tracer: PathTracer, waiting: Sequence[Any], write: Callable[..., None]) -> None:
    """Take pictures from poses; `write` is given each view, its radiance and its silhouette."""
    columns = (
        TextColumn("rendering"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    # The estimate counts samples, not views: test views have more of them.
    with Progress(*columns) as progress:
        task = progress.add_task("rendering", total=sum(view.spp for view in waiting))
        for view in waiting:
            radiance = tracer.render(view.pose, view.spp, view.seed)
            write(view, radiance, tracer.silhouette(view.pose))
            progress.advance(task, view.spp)


def _versions(mitsuba: ModuleType) -> dict[str, str]:
    names = ("mitsuba", "drjit", "numpy")
    versions = {name: importlib.metadata.version(name) for name in names}
    return {**versions, "python": platform.python_version(), "variant": mitsuba.variant()}
