"""Samples of a radiance field on a regular grid."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from nerfro.core.progress import track
from nerfro.geometry.space import Box, Space
from nerfro.registry.allowed import check
from nerfro.viewing.trained_scene import TrainedScene

RESOLUTION = 128
MIN_OPTICAL_DEPTH = 1e-3  # optical depth of a cell below which its colour is invisible
POINTS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class Volume:
    """Radiance field at the vertices of a grid; the outermost vertices lie on the faces of the box of the space.

    Attributes:
        density: density per world unit, or per unit of contracted length.
        radiance: linear radiance, averaged over the directions along the three axes; 0 in empty space.
        space: space of the grid, on the CPU.
    """

    density: Float[Tensor, "X Y Z"]
    radiance: Float[Tensor, "X Y Z 3"]
    space: Space


@torch.inference_mode()
def sample_field(
    scene: TrainedScene,
    resolution: int = RESOLUTION,
    space: Space | None = None,
    progress: bool = True,
) -> Volume:
    """Sample the radiance field of a scene on a grid.

    Args:
        scene: scene with the field.
        resolution: vertices along the longest side of the box.
        space: space with a box; by default the box of the content.
        progress: whether to show a progress bar.

    Raises:
        NerfroError: the resolution is below 2.
    """
    check("", {"resolution": Annotated[int, Ge(2)]}, {"resolution": resolution})
    content = scene.renderer.scene.space.content
    space = Box(scene.bounds if content is None else content) if space is None else copy.deepcopy(space)
    box = space.cpu().box
    field, device = scene.field, scene.renderer.scene.device
    sides = box[1] - box[0]
    counts = ((resolution - 1) * (sides / sides.max())).ceil().long() + 1
    axes = [torch.linspace(float(a), float(b), int(n)) for a, b, n in zip(*box, counts, strict=True)]
    positions = space.expand(torch.cartesian_prod(*axes))
    chunks = track("sample field", positions.split(POINTS_AT_ONCE), disable=not progress)
    density = torch.cat([field.density(chunk.to(device)).cpu() for chunk in chunks])
    density = density / space.scale(positions)
    cell = float((sides / (counts - 1)).max())
    visible = (density * cell > MIN_OPTICAL_DEPTH).nonzero()[:, 0]
    radiance = torch.zeros(len(positions), 3)
    directions = torch.cat([torch.eye(3), -torch.eye(3)])
    for rows in visible.split(POINTS_AT_ONCE):
        points = positions[rows].to(device)
        colours = [field.at_points(points, direction.to(points).expand_as(points))[1].cpu() for direction in directions]
        radiance[rows] = torch.stack(colours).mean(0)
    shape = [int(n) for n in counts]
    radiance = scene.renderer.scene.colour_space.to_linear(radiance)
    return Volume(density.view(shape), radiance.view(*shape, 3), space)
