"""The space close to the cameras that several cameras see."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.geometry.contraction import contracted_box, expand

# Cells along each side of the grid.
NUM_CELLS = 64
# Number of cameras that must see a cell close to a camera.
_MIN_CAMERAS = 3


@torch.no_grad()
def observed_cells(cameras: Cameras, centre: Float[Tensor, "3"], radius: float) -> Bool[Tensor, "cells cells cells"]:
    """Find the cells of contracted space that photographs can determine.

    A cell closer than `radius` to a camera must lie within the images of three cameras, or of all cameras if there are
    fewer; all other cells count as observed. Few rays cross the space close to a camera, and where none does, entries
    of a hash table still contain the content of other cells.

    Args:
        cameras: cameras of the photographs; paths count as straight.
        centre: centre of the ball that is not contracted.
        radius: radius of the ball.
    """
    low, high = contracted_box(centre.expand(2, 3), radius)
    middles = (torch.arange(NUM_CELLS, device=centre.device) + 0.5) / NUM_CELLS
    positions = expand(low + torch.cartesian_prod(middles, middles, middles) * (high - low), centre, radius)
    near = torch.zeros(len(positions), dtype=torch.bool, device=centre.device)
    for camera_centre in cameras.camera_to_world[:, :, 3].to(centre):
        near |= (positions - camera_centre).square().sum(-1) < radius**2
    num_cameras = torch.zeros(int(near.sum()), device=centre.device)
    size = torch.tensor([cameras.width, cameras.height], device=centre.device)
    for view in range(len(cameras)):
        pixels, depth = (values[0] for values in cameras.select([view]).project(positions[near]))
        num_cameras += ((pixels >= 0) & (pixels <= size)).all(-1) & (depth > 0)
    observed = torch.ones_like(near)
    observed[near] = num_cameras >= min(_MIN_CAMERAS, len(cameras))
    return observed.view(NUM_CELLS, NUM_CELLS, NUM_CELLS)
