"""Rendering of the missing images of a synthetic scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.core.progress import progress_bar
from nerfro.files.folder_lock import lock_folder
from nerfro.synthetic.dataset import DataSet, ViewSplits
from nerfro.synthetic.options import SynthesizeConfig
from nerfro.synthetic.path_tracer import PathTracer, load_mitsuba
from nerfro.synthetic.scene import SyntheticScene
from nerfro.synthetic.scenes import SCENES


def find_scene(name: str) -> ModuleType:
    """Return the module of a scene.

    Raises:
        NerfroError: the name is unknown.
    """
    if name not in SCENES:
        raise NerfroError(f"unknown scene '{name}'; choose one of {', '.join(SCENES)}")
    return SCENES[name]


def data_set_type(scene: ModuleType) -> type[DataSet]:
    """Return the class of the data set of a scene; the module of the scene may define it as `DATA_SET`."""
    return getattr(scene, "DATA_SET", ViewSplits)


def build_scene(name: str, resolution: int) -> SyntheticScene:
    """Model a scene. Colours have a resolution of half a pixel in images of `resolution` pixels."""
    module = find_scene(name)
    return module.build(spacing=max(0.5 * data_set_type(module).WIDTH / resolution, 0.0025))


def synthesize(options: SynthesizeConfig) -> DataSet:
    """Render the missing images of a data set.

    Args:
        options: options of the command.

    Raises:
        NerfroError: Mitsuba is missing, or `out` contains another data set or other files.
    """
    if len(options.absorption) != 3:
        raise NerfroError(f"absorption={list(options.absorption)} is not allowed; give red, green and blue")
    folder = user_path(options.out or f"outputs/scenes/{options.scene}")
    with lock_folder(folder, "out"):
        return _synthesize(options, folder)


def _synthesize(options: SynthesizeConfig, folder: Path) -> DataSet:
    scene = build_scene(options.scene, options.resolution)
    ior = scene.ior if options.ior is None else options.ior
    scene = replace(scene, absorption=tuple(options.absorption), ior=ior)
    mitsuba = load_mitsuba(options.variant)  # a missing Mitsuba is reported before files are removed
    data = data_set_type(find_scene(options.scene))(options, scene, folder)
    data.prepare(mitsuba)
    planned = data.planned()
    waiting = data.missing(planned)
    print(f"{options.scene}: {len(planned)} {data.NOUN}, {len(planned) - len(waiting)} of them already in {folder}")
    if waiting:
        tracer = PathTracer(data.lit(), options.fresnel, data.camera, options.variant)
        # The remaining time is estimated from samples, because test views have more samples.
        with progress_bar("render", sum(image.spp for image in waiting)) as bar:
            for image in waiting:
                radiance = tracer.render(image.pose, image.spp, image.seed)
                data.write(image, radiance, tracer.silhouette(image.pose))
                bar.update(image.spp)
    data.finish(planned)
    return data
