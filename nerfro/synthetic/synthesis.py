"""Rendering of the missing images of a synthetic scene."""

from __future__ import annotations

from dataclasses import replace
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
        module = find_scene(options.scene)
        data_type: type[DataSet] = getattr(module, "DATA_SET", ViewSplits)
        # Colours have a resolution of half a pixel of the images.
        scene: SyntheticScene = module.build(spacing=max(0.5 * data_type.WIDTH / options.resolution, 0.0025))
        ior = scene.ior if options.ior is None else options.ior
        mitsuba = load_mitsuba(options.variant)  # a missing Mitsuba is reported before files are removed
        data = data_type(options, replace(scene, absorption=tuple(options.absorption), ior=ior), folder)
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
