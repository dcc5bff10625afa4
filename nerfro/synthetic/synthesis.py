"""Rendering of the missing images of a synthetic scene."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Optional

from omegaconf import MISSING, DictConfig

from nerfro.allowed import Count, Names, Natural, NotNegative, Positive, Range
from nerfro.errors import NerfroError
from nerfro.files.folder_lock import lock_folder
from nerfro.paths import user_path
from nerfro.progress import progress_bar
from nerfro.registry import discover
from nerfro.synthetic import SCENES
from nerfro.synthetic.dataset import DataSet, Views
from nerfro.synthetic.path_tracer import PathTracer, load_mitsuba
from nerfro.synthetic.scene import Scene

SceneName = Annotated[str, Names(lambda: SCENES)]


@dataclass
class ViewCounts:
    """Number of views per split."""

    train: Count = MISSING  # number of training views
    val: Count = MISSING  # number of validation views
    test: Count = MISSING  # number of test views


@dataclass
class SynthesizeConfig:
    """Options of `nerfro.synthesize`; conf/synthesize/synthesize.yaml gives and explains the defaults."""

    scene: SceneName = MISSING
    out: str = MISSING
    resolution: Annotated[int, Range(at_least=8, at_most=16384)] = MISSING
    spp: Count = MISSING
    test_spp: Count = MISSING
    views: ViewCounts = field(default_factory=ViewCounts)
    photographs: Count = MISSING
    noise: NotNegative = MISSING
    fresnel: bool = MISSING
    absorption: list[NotNegative] = MISSING
    ior: Optional[Positive] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    seed: Natural = MISSING
    sky_height: Annotated[int, Range(at_least=16, at_most=16384)] = MISSING
    extras: bool = MISSING
    variant: str = MISSING
    overwrite: bool = MISSING


def find_scene(name: str) -> ModuleType:
    """Import the module of a scene of the package or of a plugin.

    Raises:
        NerfroError: the name is unknown.
    """
    discover()
    if name not in SCENES:
        raise NerfroError(f"unknown scene '{name}'; choose one of {', '.join(SCENES)}")
    return importlib.import_module(SCENES[name])


def data_set_type(scene: ModuleType) -> type[DataSet]:
    """Return the class of the data set of a scene; the module of the scene may define it as `DATA_SET`."""
    return getattr(scene, "DATA_SET", Views)


def build_scene(name: str, resolution: int) -> Scene:
    """Model a scene. Colours have a resolution of half a pixel in images of `resolution` pixels."""
    module = find_scene(name)
    return module.build(spacing=max(0.5 * data_set_type(module).WIDTH / resolution, 0.0025))


def synthesize(config: DictConfig) -> DataSet:
    """Render the missing images of a data set.

    Args:
        config: resolved `SynthesizeConfig`.

    Raises:
        NerfroError: Mitsuba is missing, or `out` contains another data set or other files.
    """
    if len(config.absorption) != 3:
        raise NerfroError(f"absorption={list(config.absorption)} is not allowed; give red, green and blue")
    with lock_folder(user_path(config.out), "out"):
        return _synthesize(config, user_path(config.out))


def _synthesize(config: DictConfig, folder: Path) -> DataSet:
    scene = build_scene(config.scene, config.resolution)
    ior = scene.ior if config.ior is None else config.ior
    scene = replace(scene, absorption=tuple(config.absorption), ior=ior)
    mitsuba = load_mitsuba(config.variant)  # a missing Mitsuba is reported before files are removed
    data = data_set_type(find_scene(config.scene))(config, scene, folder)
    data.prepare(mitsuba)
    planned = data.planned()
    waiting = data.missing(planned)
    print(f"{config.scene}: {len(planned)} {data.NOUN}, {len(planned) - len(waiting)} of them already in {folder}")
    if waiting:
        tracer = PathTracer(data.lit(), config.fresnel, data.camera, config.variant)
        # The remaining time is estimated from samples, because test views have more samples.
        with progress_bar("render", sum(image.spp for image in waiting)) as bar:
            for image in waiting:
                radiance = tracer.render(image.pose, image.spp, image.seed)
                data.write(image, radiance, tracer.silhouette(image.pose))
                bar.update(image.spp)
    data.finish(planned)
    return data
