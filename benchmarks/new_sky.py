"""A trained scene under another scene's sky, against the path-traced truth under that sky.

    python benchmarks/new_sky.py RUN [--scene torus] [--sky ship] [--views 4] [--folder DIR]

RUN is a run folder trained on a scene of `nerfro.synthesize`, or on the embedded one, `torus`. Scores are of the
pixels in which only sky is seen, past the glass or through it: things inside keep the light of the first sky.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import nerfro
from nerfro.files import lat_long
from nerfro.files.images import save_png
from nerfro.light import to_srgb
from nerfro.registry import discover

discover()
CAMERA_ANGLE_X = import_module("nerfro_plugins.synthetic_scenes.dataset").CAMERA_ANGLE_X
path_tracer = import_module("nerfro_plugins.synthetic_scenes.path_tracer")
PathTracer, Pinhole = path_tracer.PathTracer, path_tracer.Pinhole
lat_long_texture = import_module("nerfro_plugins.synthetic_scenes.scene").lat_long_texture
build_scene = import_module("nerfro_plugins.synthetic_scenes.synthesis").build_scene

# Opacity of things inside up to which a pixel shows sky alone.
_CLEAR = 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--scene", default="torus", help="that the run was trained on")
    parser.add_argument("--sky", default="ship", help="scene whose sky is taken")
    parser.add_argument("--fresnel", action="store_true", help="partial reflection in the truth")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--texture", type=int, default=1024, help="height of the sky in texels")
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--folder", type=Path, help="for the sky, and pictures: truth above, rendered below")
    arguments = parser.parse_args()
    trained = nerfro.load(arguments.run)
    cameras = trained.cameras("test").select(list(range(arguments.views)))
    sky = build_scene(arguments.sky, cameras.width).sky
    assert sky is not None
    texture = torch.from_numpy(lat_long_texture(sky, arguments.texture)).float()
    truth = replace(build_scene(arguments.scene, cameras.width), sky=sky)
    tracer = PathTracer(truth, arguments.fresnel, Pinhole.square(CAMERA_ANGLE_X, cameras.width))
    rendered = trained.with_(sky=texture).render(cameras)
    last_row = torch.tensor([[0.0, 0, 0, 1]])
    poses = [torch.cat([pose, last_row]).double().numpy() for pose in cameras.camera_to_world.cpu()]
    exact = np.stack([tracer.render(pose, arguments.spp, number) for number, pose in enumerate(poses)])
    exact_rgb = to_srgb(torch.from_numpy(exact)).clamp(0, 1).float()
    errors = (rendered.rgb - exact_rgb).square().mean(-1)
    clear, glass = rendered.opacity <= _CLEAR, rendered.normals.norm(dim=-1) > 0
    print(f"{arguments.run} under the sky of {arguments.sky}, {arguments.views} test views, {arguments.spp} spp\n")
    print("| pixels | share of pixels | PSNR |\n|---|---|---|")
    rows = (
        ("sky alone", clear),
        ("past the glass", clear & ~glass),
        ("sky through the glass", clear & glass),
        ("things inside, in the light of the first sky", ~clear),
    )
    for name, chosen in rows:
        print(f"| {name} | {chosen.float().mean():.0%} | {decibels(errors[chosen])} |")
    if arguments.folder is not None:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        lat_long.save_lat_long(arguments.folder / "sky.hdr", texture)
        both = torch.cat([torch.cat(list(pictures), 1) for pictures in (exact_rgb, rendered.rgb)])
        save_png(arguments.folder / "new_sky.png", both)


def decibels(errors: Tensor) -> str:
    """Peak signal-to-noise ratio of squared errors."""
    return f"{-10 * math.log10(max(float(errors.double().mean()), 1e-12)):.2f}" if len(errors) else ""


if __name__ == "__main__":
    main()
