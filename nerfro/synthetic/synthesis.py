"""Rendering of the missing images of a synthetic scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from nerfro.core.cameras import room_rotations
from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.core.progress import progress_bar
from nerfro.files import lat_long
from nerfro.files.atomic import lock_folder
from nerfro.geometry.gltf import is_gltf
from nerfro.synthetic.dataset import DataSet, ViewSplits
from nerfro.synthetic.gltf_scene import GltfScene
from nerfro.synthetic.options import SynthesizeConfig
from nerfro.synthetic.path_tracer import PathTracer, load_mitsuba
from nerfro.synthetic.scene import Sky, SyntheticScene
from nerfro.synthetic.scenes import SCENES


def find_scene(name: str) -> ModuleType | GltfScene:
    """Return the module of a scene, or the scene of a glTF file.

    Raises:
        NerfroError: the name is unknown, or the file cannot be used.
    """
    if name in SCENES:
        return SCENES[name]
    if is_gltf(Path(name)):
        return GltfScene(user_path(name))
    raise NerfroError(f"unknown scene '{name}'; choose one of {', '.join(SCENES)}, or a glTF file (.glb, .gltf)")


def load_sky(path: Path) -> Sky:
    """Return the radiance of a lat-long image as a function of the direction."""
    image = lat_long.load_lat_long(path)

    def sky(directions: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(np.asarray(directions, np.float32)).reshape(-1, 3)
        return lat_long.sample(image, points, image.shape[1]).numpy().reshape(directions.shape)

    return sky


def synthesize(options: SynthesizeConfig) -> DataSet:
    """Render the missing images of a data set.

    Args:
        options: options of the command.

    Raises:
        NerfroError: Mitsuba is missing, or `out` contains another data set or other files.
    """
    if len(options.absorption) != 3:
        raise NerfroError(f"absorption={list(options.absorption)} is not allowed; give red, green and blue")
    folder = user_path(options.out or f"outputs/scenes/{Path(options.scene).stem}")
    module, sky = find_scene(options.scene), None if options.sky is None else load_sky(user_path(options.sky))
    with lock_folder(folder, "out"):
        data_type: type[DataSet] = getattr(module, "DATA_SET", ViewSplits)
        for name, default in (("format", "png"), ("cameras", "orbit"), ("turntable", False)):
            if getattr(options, name) != default and name not in data_type.OPTIONS:
                raise NerfroError(f"scene={options.scene} has no option {name}; leave it out, or take another scene")
        if options.cameras == "file" and not options.scene.lower().endswith((".glb", ".gltf")):
            raise NerfroError("cameras=file takes the cameras of a glTF file; choose orbit, above or ring")
        # Colours have a resolution of half a pixel of the images.
        scene: SyntheticScene = module.build(spacing=max(0.5 * data_type.WIDTH / options.resolution, 0.0025))
        scene = scene.with_glass(options.ior, tuple(options.absorption))
        if sky is not None:
            scene = replace(scene, sky=sky)
        if options.turntable and scene.sky is None:
            raise NerfroError(f"turntable=true needs a sky, and scene={options.scene} has a room; choose another scene")
        mitsuba = load_mitsuba(options.variant)  # a missing Mitsuba is reported before files are removed
        data = data_type(options, scene, folder)
        data.prepare(mitsuba)
        planned = data.planned()
        waiting = data.missing(planned)
        print(f"{options.scene}: {len(planned)} {data.NOUN}, {len(planned) - len(waiting)} of them already in {folder}")
        if waiting:
            tracer = PathTracer(data.lit(), options.fresnel, data.camera, options.variant)
            # The remaining time is estimated from samples, because test views have more samples.
            with progress_bar("render", sum(image.spp for image in waiting)) as bar:
                for image in waiting:
                    if options.turntable:
                        pose = torch.from_numpy(image.pose[:3])
                        tracer.turn_sky(room_rotations(pose, (0.0, 0.0, 1.0)).numpy().T)
                    radiance = tracer.render(image.pose, image.spp, image.seed)
                    data.write(image, radiance, tracer.silhouette(image.pose))
                    bar.update(image.spp)
        data.finish(planned)
    return data
