"""Samples of a radiance field on a regular grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from nerfro.core.progress import track
from nerfro.geometry.contraction import contraction_scale, expand
from nerfro.registry.allowed import check
from nerfro.viewing.trained_scene import TrainedScene

RESOLUTION = 128
MIN_OPTICAL_DEPTH = 1e-3  # optical depth of a cell below which its colour is invisible
POINTS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class Volume:
    """Radiance field at the vertices of a grid; the outermost vertices lie on the faces of a box.

    Attributes:
        density: density per world unit, or per unit of contracted length.
        radiance: linear radiance, averaged over the directions along the three axes; 0 in empty space.
        box: corners, world units.
        radius: radius around the centre of the box beyond which space is contracted; None without contraction.
    """

    density: Float[Tensor, "X Y Z"]
    radiance: Float[Tensor, "X Y Z 3"]
    box: Float[Tensor, "2 3"]
    radius: float | None = None


@torch.inference_mode()
def sample_field(
    scene: TrainedScene,
    resolution: int = RESOLUTION,
    box: Float[Tensor, "2 3"] | None = None,
    progress: bool = True,
    radius: float | None = None,
) -> Volume:
    """Sample the radiance field of a scene on a grid.

    Args:
        scene: scene with the field.
        resolution: vertices along the longest side of the box.
        box: corners, world units; by default the bounds of the content.
        progress: whether to show a progress bar.
        radius: radius around the centre of the box beyond which space is contracted (`geometry.contraction`).

    Raises:
        NerfroError: the resolution is below 2.
    """
    check("", {"resolution": Annotated[int, Ge(2)]}, {"resolution": resolution})
    if box is None:
        box = scene.bounds if scene.content is None else scene.content
    field, device = scene.field, scene.renderer.scene.device
    sides = box[1] - box[0]
    counts = ((resolution - 1) * sides / sides.max()).ceil().long() + 1
    axes = [torch.linspace(float(a), float(b), int(n)) for a, b, n in zip(*box, counts, strict=True)]
    positions, scale = torch.cartesian_prod(*axes), torch.ones(())
    if radius is not None:
        positions = expand(positions, box.mean(0), radius)
        scale = contraction_scale(positions, box.mean(0), radius)
    chunks = track("sample field", positions.split(POINTS_AT_ONCE), disable=not progress)
    density = torch.cat([field.density(chunk.to(device)).cpu() for chunk in chunks])
    density = density / scale
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
    return Volume(density.view(shape), radiance.view(*shape, 3), box, radius)
