"""What is inside the glass, on a grid: density and colour, and the surface around what is solid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.geometry.contraction import contraction_scale, expand
from nerfro.geometry.interpolation import trilinear
from nerfro.geometry.mesh import TriangleMesh
from nerfro.types import Samples
from nerfro.viewing.scene import Scene
from nerfro.viewing.surface import level_set, without_crumbs

RESOLUTION = 128
# Optical depth along a cell below which nobody sees its colour.
UNSEEN = 1e-3
_POINTS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class Volume:
    """The radiance field at the vertices of a grid whose first and last ones lie on the faces of a box."""

    density: Float[Tensor, "X Y Z"]  # per world unit, or unit of contracted length
    rgb: Float[Tensor, "X Y Z 3"]  # linear radiance, the mean of what is seen along the three axes; 0 in empty space
    box: Float[Tensor, "2 3"]  # corners, world units
    radius: float | None = None  # of the ball around the box's middle beyond which space is contracted in the grid


@torch.inference_mode()
def bake(
    scene: Scene,
    resolution: int = RESOLUTION,
    box: Float[Tensor, "2 3"] | None = None,
    progress: bool = True,
    radius: float | None = None,
) -> Volume:
    """The field of a scene on a grid over a box, by default that of all it holds.

    Args:
        scene: whose field is asked.
        resolution: vertices on the box's longest side.
        box: corners, world units.
        progress: whether to show a bar.
        radius: with one, space is contracted beyond this distance from the box's middle (`geometry.contraction`).
    """
    if box is None:
        box = scene.bounds if scene.content is None else scene.content
    field, device = scene.field, scene.model.device
    sides = box[1] - box[0]
    counts = ((resolution - 1) * sides / sides.max()).ceil().long() + 1
    axes = [torch.linspace(float(a), float(b), int(n)) for a, b, n in zip(*box, counts, strict=True)]
    positions = torch.cartesian_prod(*axes)
    smaller = torch.ones(())
    if radius is not None:
        positions = expand(positions, box.mean(0), radius)
        smaller = contraction_scale(positions, box.mean(0), radius)
    above = torch.tensor([0.0, 0.0, -1.0])
    blocks = positions.split(_POINTS_AT_ONCE)
    blocks = tqdm(blocks, unit="block", desc="bake", dynamic_ncols=True, disable=not progress)
    density = torch.cat([ask(field, some.to(device), above.expand_as(some))[0].cpu() for some in blocks])
    density = density / smaller
    cell = float((sides / (counts - 1)).max())
    seen = (density * cell > UNSEEN).nonzero()[:, 0]
    rgb = torch.zeros(len(positions), 3)
    along = torch.cat([torch.eye(3), -torch.eye(3)])
    for rows in seen.split(_POINTS_AT_ONCE):
        where = positions[rows].to(device)
        colours = [ask(field, where, direction.expand_as(where))[1].cpu() for direction in along]
        rgb[rows] = torch.stack(colours).mean(0)
    shape = [int(n) for n in counts]
    return Volume(density.view(shape), scene.model.linear(rgb).view(*shape, 3), box, radius)


def ask(
    field: Field, positions: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P 3"]]:
    """Density, and radiance as the field gives it, at points seen in unit directions."""
    nothing = torch.zeros(len(positions), 1, device=positions.device)
    edges = torch.cat([nothing, nothing], 1)
    directions = directions.to(positions)
    found = field(Samples(positions[:, None], directions[:, None], nothing, edges, nothing[:, 0]))
    return found.density[:, 0].float(), found.rgb[:, 0].float()


def find_half_depth(scene: Scene, given: float | None) -> float:
    """The length that `solid_surface` goes by: the given one, or a hundredth of the object's longest side."""
    return float((scene.bounds[1] - scene.bounds[0]).max()) / 100 if given is None else given


@dataclass(frozen=True)
class ColouredMesh:
    """A surface with the radiance that it is seen with from in front."""

    mesh: TriangleMesh
    normals: Float[Tensor, "V 3"]  # unit, outwards
    radiance: Float[Tensor, "V 3"]  # linear


@torch.inference_mode()
def solid_surface(scene: Scene, volume: Volume, half_depth: float) -> ColouredMesh:
    """Marching cubes around what is solid: where half the light is lost within `half_depth` world units.

    Small parts apart from the rest are left out.

    Raises:
        NerfroError: nothing inside is that dense.
    """
    level = math.log(2) / half_depth
    # What touches the box's faces is closed there.
    padded = functional.pad(volume.density, (1,) * 6)
    spacing = (volume.box[1] - volume.box[0]) / (torch.tensor(volume.density.shape) - 1)
    box = volume.box + torch.stack([-spacing, spacing])
    try:
        # The logarithm is nearer to linear across a surface than a density that doubles from cell to cell.
        mesh = without_crumbs(level_set(padded.clamp(min=1e-3 * level).log(), box, math.log(level)))
    except NerfroError as error:
        raise NerfroError(f"nothing inside is so dense that half the light is lost within {half_depth:g}") from error
    vertices = torch.from_numpy(mesh.vertices).float()
    gradients = torch.stack(torch.gradient(padded.clamp(min=1e-3 * level).log()), -1) / spacing
    normals = -functional.normalize(trilinear(gradients, box, vertices), dim=-1)
    radiance = [
        ask(scene.field, places.to(scene.model.device), towards)[1].cpu()
        for places, towards in zip(vertices.split(_POINTS_AT_ONCE), (-normals).split(_POINTS_AT_ONCE), strict=True)
    ]
    return ColouredMesh(mesh, normals, scene.model.linear(torch.cat(radiance)))
