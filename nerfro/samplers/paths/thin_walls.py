"""Warning of walls that are too thin for a grid of signed distances."""

from __future__ import annotations

import math

import numpy as np
import torch

from nerfro.core.errors import NerfroError, warn
from nerfro.geometry.bodies import WallSettings, points_below, thickness
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.samplers.base import PathSampler
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.traced_file import make_rays


def warn_of_thin_walls(sampler: PathSampler, medium: Medium, settings: WallSettings = WallSettings()) -> None:
    """Print a warning for each body with walls that are too thin for its grid, unless the sampler traces triangles."""
    bodies = medium.bodies
    if sampler.traces_triangles or not sampler.needs_medium or bodies is None:
        return
    error = None
    for name, mesh, grid in zip(bodies.names, bodies.meshes, bodies.grids, strict=False):
        if not mesh.is_closed:
            continue
        try:
            voxels = thickness(mesh, settings=settings) / float(grid.spacing.max())
        except NerfroError:  # without Embree
            return
        thin = voxels < settings.voxels
        if thin.mean() <= settings.few:
            continue
        if error is None:
            error = _median_error(bodies, settings.num_rays)
        if error < settings.least_error:
            return
        factor = settings.voxels / float(np.quantile(voxels, settings.few))
        resolution = math.ceil((len(grid.distances) - 1) * factor) + 1
        finer = f"raise the resolution of the grid to {resolution}, " if resolution <= settings.most_vertices else ""
        warn(
            f"{thin.mean():.0%} of the surface of {name} bounds walls of about {np.median(voxels[thin]):.1f} voxels, "
            f"which bend rays in wrong directions below {settings.voxels:.0f} voxels; {finer}trace triangles "
            "(sampler/path=snell sampler.path.interface=mesh), or describe a cavity as a body of index 1"
        )


def _median_error(bodies: Bodies, num_rays: int) -> float:
    """Return the median angle between exit directions behind the grids and behind the triangles, degrees.

    Rays start in all directions around the bodies and aim at random points of the first surface.
    """
    mesh, medium = bodies.meshes[0], bodies.achromatic()
    target, _ = points_below(mesh, num_rays)
    start = torch.randn(num_rays, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    size = torch.linalg.vector_norm(medium.box[1] - medium.box[0]).double().cpu()
    start = target.mean(0) + 2 * size * torch.nn.functional.normalize(start, dim=-1)
    towards = torch.nn.functional.normalize(target - start, dim=-1)
    rays = make_rays(start + torch.from_numpy(medium.origin), towards, medium, 0.0, None)
    by_grid, by_triangles = (Snell(interface)(rays, medium).exit_directions for interface in ("sdf", "mesh"))
    return float(torch.rad2deg(2 * torch.asin((0.5 * (by_grid - by_triangles).norm(dim=-1)).clamp(max=1))).median())
