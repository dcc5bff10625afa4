"""A signed distance that learns: a given one and smooth offsets, from coarse to fine."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerfro.capture.visual_hull import extract_surface
from nerfro.geometry.interpolation import spline_coefficients
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.media.sdf_grid import SdfGrid

# Voxels of air on each side of the object, and around the surface within which distances are exact.
_MARGIN, _BAND = 8, 6.0
# Resolutions of the offsets' grids, as shares of the distances'.
_SHARES = (1 / 8, 1 / 4, 1 / 2, 1)
# Tilts of the surface from voxel to voxel, radians, from which on they are taken for an edge: smoothing costs no more.
_EDGE = 0.02


class LearnedDistance(nn.Module):
    """Signed distances of a mesh on a grid, and what was learned to add to them.

    The offsets are a sum of grids: a step of a coarse one moves a wide part of the surface.

    Args:
        mesh: to begin with.
        resolution: voxels along the longest side of the mesh.
    """

    given: Float[Tensor, "X X X"]
    box: Float[Tensor, "2 3"]

    def __init__(self, mesh: TriangleMesh, resolution: int) -> None:
        super().__init__()
        self.spacing = float(np.ptp(mesh.bounds, axis=0).max()) / resolution
        side = resolution + 2 * _MARGIN
        corner = mesh.bounds.mean(0) - 0.5 * self.spacing * side
        box = np.stack([corner, corner + self.spacing * side])
        given = torch.from_numpy(signed_distance_grid(mesh, box, side + 1, _BAND)).float()
        self.register_buffer("given", given)
        self.register_buffer("box", torch.from_numpy(box).float())
        self.register_buffer("_near", (given.abs() < (_BAND - 2) * self.spacing).float())
        sides = [round(share * side) + 1 for share in _SHARES]
        self.offsets = nn.ParameterList(nn.Parameter(torch.zeros(1, 1, n, n, n)) for n in sides)

    def offset(self) -> Float[Tensor, "X X X"]:
        """What is added to the given distances, world units."""
        size = self.given.shape
        total = torch.zeros_like(self.given)
        for grid in self.offsets:
            wide = functional.interpolate(grid, size, mode="trilinear", align_corners=True)
            total = total + wide[0, 0]
        return total

    def medium(self, iors: list[float], offset: Float[Tensor, "X X X"]) -> SdfGrid:
        """The body with these distances, which has gradients by the offset."""
        distances = (self.given + offset)[None]
        medium = SdfGrid.from_distances(distances.detach(), self.box, iors, 0.1 * self.spacing)
        medium.coefficients = spline_coefficients(distances[0])[None]
        return medium

    def roughness(self, offset: Float[Tensor, "X X X"]) -> Float[Tensor, ""]:
        """Mean tilt that the offset gives the surface from voxel to voxel: quadratic, and level at edges.

        Second differences in units of the spacing, t^2 / (t^2 + edge^2), near the surface.
        """
        total = offset.new_zeros(())
        for axis in range(3):
            tilt = offset.diff(n=2, dim=axis) / self.spacing
            near = self._near.narrow(axis, 1, tilt.shape[axis])
            square = tilt.square()
            total = total + (near * square / (square + _EDGE**2)).sum() / near.sum()
        return total / 3

    @torch.no_grad()
    def mesh(self) -> TriangleMesh:
        """The surface."""
        return extract_surface(
            (self.given + self.offset()).double().numpy(), self.box[0].double().numpy(), self.spacing
        )
