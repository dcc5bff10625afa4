"""Measure the error of exit directions, in degrees, if a simpler medium replaces a glass of water.

`python benchmarks/vessel.py` makes a conical glass, open at the top and two thirds full, and traces rays from all
sides. It prints the errors of the exit directions of the rays that reach the wall.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
import trimesh

from nerfro.core.rays import Rays
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.media.vessel import make_vessel
from nerfro.samplers.paths.snell import Snell
from tests.closed_forms import angle, make_rays

# A drinking glass in millimetres.
HEIGHT, RADIUS_BELOW, RADIUS_ABOVE, WALL, FOOT, LEVEL = 120.0, 30.0, 38.0, 2.5, 10.0, 80.0
MILLIMETRES_PER_UNIT = 60.0  # of the world
LIQUID = 3  # `path.body` of the liquid; wall and cavity are 1 and 2
BOX = [[-1.2] * 3, [1.2] * 3]


def main() -> None:
    """Print a line for each simpler medium."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=20000)
    parser.add_argument("--resolution", type=int, default=128)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "glass.ply"
        corners = [[0, 0], [RADIUS_BELOW, 0], [RADIUS_ABOVE, HEIGHT], [0, HEIGHT]]
        outline = (np.array(corners) - [0, HEIGHT / 2]) / MILLIMETRES_PER_UNIT
        trimesh.creation.revolve(outline, sections=256).export(mesh)
        grid = {"resolution": given.resolution, "box_min": BOX[0], "box_max": BOX[1], "cache": False}
        lengths = {"wall": WALL, "foot": FOOT, "level": LEVEL}

        def vessel(**changed: float) -> Bodies:
            return make_vessel(str(mesh), **(lengths | changed), height=HEIGHT, **grid)

        true = vessel()
        rays = rays_at(given.rays)
        reference_path = Snell()(rays, true)
        wet = (reference_path.body == LIQUID).any(-1)
        dry = reference_path.refracted & ~wet
        print(
            f"error of the exit direction: median in degrees, and share of more than a degree; of {int(wet.sum())} rays"
        )
        print(f"through the water, and of {int(dry.sum())} through the wall alone")
        for name, medium in {
            "solid of water, 1.333": make_bodies(str(mesh), 1.333, **grid),
            "solid of glass, 1.5": make_bodies(str(mesh), 1.5, **grid),
            "full to the brim": vessel(level=HEIGHT),
            "empty": vessel(liquid_ior=1.0),
            "wall thicker by 10 %": vessel(wall=1.1 * WALL),
            "wall thicker by 50 %": vessel(wall=1.5 * WALL),
            "level higher by 1 mm": vessel(level=LEVEL + 1),
            "level higher by 5 mm": vessel(level=LEVEL + 5),
            "wall of 1.52": vessel(ior=1.52),
        }.items():
            errors = angle(Snell()(rays, medium).exit_directions, reference_path.exit_directions)
            parts = (f"{errors[part].median():8.2f}{(errors[part] > 1).double().mean():7.0%}" for part in (wet, dry))
            print(f"{name:24}{''.join(parts)}")


def rays_at(count: int) -> Rays:
    """Return rays to points in the glass, from cameras 4 units away and from 6 degrees below to 46 degrees above it."""
    random = torch.Generator().manual_seed(0)
    turn, height, radius, other, z = torch.rand(5, count, generator=random, dtype=torch.float64)
    raised = height.mul(0.9).sub(0.1)  # radians
    eyes = torch.stack([raised.cos() * (6.28 * turn).cos(), raised.cos() * (6.28 * turn).sin(), raised.sin()], -1)
    wide = RADIUS_ABOVE / MILLIMETRES_PER_UNIT * radius.sqrt()
    targets = torch.stack(
        [wide * (6.28 * other).cos(), wide * (6.28 * other).sin(), (2 * z - 1) * 0.5 * HEIGHT / MILLIMETRES_PER_UNIT],
        -1,
    )
    return make_rays(4.0 * eyes, targets - 4.0 * eyes, 0.5, 9.0)


if __name__ == "__main__":
    main()
