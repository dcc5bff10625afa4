"""Homogeneous bodies made from meshes: signed distances on a grid with a continuous gradient."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from nerfro.allowed import NotNegative, Positive, Resolution
from nerfro.errors import NerfroError
from nerfro.files.cache import cached_arrays, content_hash
from nerfro.geometry.bodies import require_separate
from nerfro.geometry.interpolation import quadratic_spline, spline_coefficients
from nerfro.geometry.intersection import LayeredIntersector, Triangles
from nerfro.geometry.mesh import TriangleMesh, load_mesh, local_origin
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.kernels.available import require_bytes
from nerfro.kernels.constants import constant
from nerfro.media.base import Scalars, Vectors, lazy_buffer
from nerfro.media.solid import Solid
from nerfro.media.voxel_grid import BYTES_PER_VERTEX, check_margin, grid_box
from nerfro.paths import resolve_path
from nerfro.registry import register
from nerfro.variants import variant

# Voxels of air around the object if its box is not given.
AIR = 4

# Half width in voxels of the band around the surface in which the distance is exact. It covers the support of the
# spline and the step that brackets the surface.
BAND = 3.0
# Cells along each side of the blocks that store a lower bound of the distance, and of the blocks that store whether
# they may contain a surface. docs/lab/rendering_speed.md has times for 3 and 4 cells.
BLOCK, SURFACE_BLOCK = 4, 3
# A quadratic spline that is extrapolated by half a cell at a corner is a sum of coefficients whose positive weights add
# up to 2.19 and whose negative weights to -1.19. It is positive if the largest coefficient is less than 1.84 times the
# smallest.
_CONTINUED = 1.8
# Part of the cache key. Increase it when the same mesh and settings give different distances.
_VERSION = 3


@register("medium", "sdf_grid")
class SdfGrid(Solid):
    """Bodies of constant index bounded by meshes: sharp surfaces for `snell`, thin shells for `eikonal`.

    Args:
        mesh: closed triangle mesh of the outer body, world units, any format trimesh reads.
        ior: refractive index inside the mesh.
        inner_meshes: meshes of inner bodies (a liquid, a bubble), each inside all bodies before it. Opaque objects do
            not belong here, because they do not refract.
        inner_iors: refractive index of each inner body.
        learn_ior: refine all refractive indices in training.
        resolution: vertices along each side of the grid.
        box_min, box_max: corners of the grid, world units; None for the bounds of the mesh and a margin of air.
        shell_voxels: half width of the smooth interface that the Eikonal equation sees, voxels.
        accept_open_mesh: accept meshes with holes. Rays along three axes decide by majority whether a point is inside.
        absorption: absorption coefficients per world unit: red, green and blue of each body, or one number for all;
            only for `sampler/path=snell`.
        learn_absorption: learn the absorption; only for `sampler/path=snell`.
        abbe: Abbe number of each body, or one for all bodies, for dispersion; only for `sampler/path=snell`.
        cache: keep the distances in the cache folder.

    Attributes:
        meshes: the meshes of the bodies; empty if the medium was made from distances.
        distances: signed distance of each body at the vertices of the grid [K, X, Y, Z], world units.
        coefficients: coefficients of the quadratic B-splines through `distances`.
    """

    distances: Float[Tensor, "K X Y Z"]
    coefficients: Float[Tensor, "K X Y Z"]

    def __init__(
        self,
        mesh: str,
        ior: Positive = 1.5,
        inner_meshes: list[str] = [],  # noqa: B006 (the registry reads and copies it)
        inner_iors: Sequence[Positive] = (),
        resolution: Resolution = 128,
        box_min: Sequence[float] | None = None,
        box_max: Sequence[float] | None = None,
        shell_voxels: Positive = 0.1,
        accept_open_mesh: bool = False,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
        abbe: Sequence[Positive] = (),
        learn_ior: bool = False,
        cache: bool = True,
    ) -> None:
        if len(inner_meshes) != len(inner_iors):
            raise NerfroError(
                f"medium.inner_meshes has {len(inner_meshes)} entries and medium.inner_iors {len(inner_iors)}; "
                "give one index for each inner mesh"
            )
        require_bytes(BYTES_PER_VERTEX * resolution**3, f"medium.resolution={resolution}")
        meshes = [load_mesh(resolve_path(path), accept_open_mesh) for path in (mesh, *inner_meshes)]
        box = grid_box(box_min, box_max, meshes, resolution, AIR)
        spacing = (box[1] - box[0]) / (resolution - 1)
        shell = shell_voxels * float(spacing.min())
        super().__init__([ior, *inner_iors], shell, absorption, learn_absorption, abbe, learn_ior)
        for body in meshes:
            check_margin(body, box, resolution, 2)
        self.origin = local_origin(meshes[0].vertices)
        box, self.meshes = box - self.origin, [body.relative_to(self.origin) for body in meshes]
        distances = []
        for body in self.meshes:
            if body.is_closed:
                require_separate(body)
            distances.append(cached_distance(body, box, resolution, BAND, cache))
        self._set(torch.from_numpy(np.stack(distances)), torch.from_numpy(box).float())

    @classmethod
    def from_distances(
        cls,
        distances: Float[Tensor, "K X Y Z"],
        box: Float[Tensor, "2 3"],
        iors: Sequence[float],
        shell: float,
        **glass: Any,
    ) -> SdfGrid:
        """Make the medium from signed distances.

        Args:
            distances: of each body at the vertices of a grid, world units; negative inside, positive at the border.
            box: lower and upper corner of the grid, world units.
            iors: refractive index of each body.
            shell: half width of the smooth interface, world units.
            glass: further arguments of `Solid`.
        """
        medium = cls.__new__(cls)
        Solid.__init__(medium, iors, shell, **glass)
        medium.meshes = []
        medium._set(distances, box)
        return medium

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the outer mesh, world units; the box of the grid if there is no mesh."""
        return torch.from_numpy(self.meshes[0].bounds).float() if self.meshes else self.box

    @property
    def spacing(self) -> Float[Tensor, "3"]:
        """Distance between neighbouring vertices, world units."""
        return (self.box[1] - self.box[0]) / (constant(self.distances.shape[1:], self.box.device) - 1)

    def grown(self, outwards: Float[Tensor, "X Y Z"]) -> SdfGrid:
        """Return the same bodies with the outer surface displaced.

        The displacement is subtracted from the distances, so that these are exact only for small displacements.

        Args:
            outwards: outward displacement at the vertices of the grid, world units.
        """
        return self._with_distances(torch.cat([self.distances[:1] - outwards, self.distances[1:]]), meshes=[])

    def _with_distances(self, distances: Float[Tensor, "K X Y Z"], **changes: Any) -> Any:
        changed = variant(self, **changes)
        for name in ("_coarse_clearance", "_coarse_slopes", "_empty_blocks"):  # bounds of the old distances
            changed._buffers.pop(name, None)
        changed._set(distances, self.box)
        return changed

    def at_wavelength(self, wavelength: float) -> SdfGrid:
        self.coarse_clearance, self.coarse_slopes, self.empty_blocks  # noqa: B018 (computed once, and shared by all wavelengths)
        return super().at_wavelength(wavelength)

    @cached_property
    def triangles(self) -> Triangles:
        """Triangles of all meshes."""
        return Triangles.of(self.meshes)

    @cached_property
    def intersector(self) -> LayeredIntersector:
        """Intersector of `triangles`."""
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        faces = [mesh.faces + start for mesh, start in zip(self.meshes, starts, strict=False)]
        return LayeredIntersector(self.triangles.corners, np.concatenate(faces))

    @lazy_buffer
    def coarse_clearance(self) -> Float[Tensor, "x y z"]:
        """Lower bound of the distance to all surfaces from any point of each block of `BLOCK`^3 cells, world units."""
        blocks = torch.tensor(self.coefficients.shape[1:]).sub(1).div(BLOCK, rounding_mode="floor").add(1).tolist()
        nearest = self.distances.abs().amin(0).cpu()
        for axis, count in enumerate(blocks):
            # Neighbouring blocks share their boundary vertices.
            last = torch.arange(count * BLOCK + 1).clamp(max=nearest.shape[axis] - 1)
            nearest = nearest.index_select(axis, last).unfold(axis, BLOCK + 1, BLOCK).amin(-1)
        spacing = self.spacing.cpu()
        # A point is within half a cell diagonal of a vertex, and the spline does not pass exactly through the data.
        margin = 0.5 * torch.linalg.vector_norm(spacing) + 0.25 * spacing.min()
        return (nearest - margin).clamp(min=0).to(self.distances.device)

    @lazy_buffer
    def coarse_slopes(self) -> Float[Tensor, "K x y z 3 2"]:
        """Lowest and highest derivative of each body's spline along the axes in each block of `SURFACE_BLOCK`^3 cells.

        A derivative is a weighted mean of differences of neighbouring coefficients, which therefore bound it. At the
        border of the grid splines are extrapolated, and the bounds are infinite.
        """
        spacing = self.spacing.cpu()
        values = self._coefficients_of_blocks()
        bounds = []
        for axis in range(3):
            slopes = values.diff(dim=axis + 1) / spacing[axis]
            windows = [SURFACE_BLOCK + 3 - (other == axis) for other in range(3)]
            bounds.append(torch.stack(_extremes(slopes, windows), -1))
        found = torch.stack(bounds, -2)
        found[:, self._border_blocks()] = found.new_tensor([-torch.inf, torch.inf])
        return found

    @lazy_buffer
    def empty_blocks(self) -> UInt8[Tensor, "x y z"]:
        """Lower bound of the Chebyshev distance to the next block of `SURFACE_BLOCK`^3 cells that may hold a surface.

        0 means that the block itself may hold a surface. A block without sign changes of the coefficients has none,
        because the values of a spline lie between its coefficients. This does not hold at the border of the grid, where
        splines are extrapolated.
        """
        lowest, highest = _extremes(self._coefficients_of_blocks(), [SURFACE_BLOCK + 3] * 3)
        outside = lowest > torch.where(self._border_blocks(), highest / _CONTINUED, 0)
        empty = (outside | ((highest < 0) & ~self._border_blocks())).all(0)
        return torch.from_numpy(distance_transform_cdt(empty.numpy(), "chessboard").clip(0, 255).astype(np.uint8))

    def _coefficients_of_blocks(self) -> Float[Tensor, "K X Y Z"]:
        """Return the coefficients of all blocks of `SURFACE_BLOCK`^3 cells and their neighbours, on the CPU."""
        values = self.coefficients.detach().cpu()
        for axis, count in enumerate(values.shape[1:], start=1):
            blocks = (count - 1) // SURFACE_BLOCK + 1
            values = values.index_select(axis, torch.arange(-1, blocks * SURFACE_BLOCK + 2).clamp(0, count - 1))
        return values

    def _border_blocks(self) -> Bool[Tensor, "x y z"]:
        """Return the blocks of `SURFACE_BLOCK`^3 cells in which splines are extrapolated beyond the grid."""
        axes = []
        for count in self.coefficients.shape[1:]:
            block = torch.arange((count - 1) // SURFACE_BLOCK + 1)
            axes.append((block == 0) | ((block + 1) * SURFACE_BLOCK > count - 2))
        x, y, z = axes
        return x[:, None, None] | y[:, None] | z

    def clearance(self, positions: Vectors) -> Scalars:
        """Return the distance to the nearest shell: a lower bound from the blocks, or near a shell the distance."""
        grid = self.coarse_clearance
        vertices = constant(self.coefficients.shape[1:], grid.device)
        block = ((positions - self.box[0]) * (vertices - 1) / (self.box[1] - self.box[0]) / BLOCK).floor().long()
        x, y, z = torch.minimum(block.clamp(min=0), constant(grid.shape, grid.device) - 1).unbind(-1)
        coarse = grid[x, y, z] - self.shell
        near = coarse <= 0
        clearance = coarse.to(positions.dtype, copy=True)
        clearance[near] = super().clearance(positions[near])
        return clearance

    def _set(self, distances: Tensor, box: Tensor) -> None:
        # Grids are rebuilt from the mesh at every start and do not belong in checkpoints.
        self.register_buffer("box", box, persistent=False)
        coefficients = torch.stack([spline_coefficients(values) for values in distances])
        self.register_buffer("coefficients", coefficients, persistent=False)
        self.register_buffer("distances", distances, persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Interpolate the distances by splines, with their exact gradients."""
        splines = [quadratic_spline(coefficients, self.box, positions) for coefficients in self.coefficients]
        return torch.stack([phi for phi, _ in splines], -1), torch.stack([gradient for _, gradient in splines], -2)


def _extremes(values: Float[Tensor, "K X Y Z"], windows: list[int]) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest value [K, x, y, z] in windows along each axis that are `SURFACE_BLOCK` apart."""
    lowest = highest = values
    for axis, window in enumerate(windows, start=1):
        lowest = lowest.unfold(axis, window, SURFACE_BLOCK).amin(-1)
        highest = highest.unfold(axis, window, SURFACE_BLOCK).amax(-1)
    return lowest, highest


def cached_distance(
    mesh: TriangleMesh,
    box: Float[np.ndarray, "2 3"],
    resolution: int,
    band: float,
    cache: bool,
    lid: Bool[np.ndarray, "F"] | None = None,
) -> Float[np.ndarray, "X Y Z"]:
    """Compute the signed distance to a mesh at the vertices of a grid, or load it from the cache folder."""
    normals = "none" if mesh.normals is None else mesh.normals
    settings = box, resolution, band
    left_out = () if lid is None else (lid,)
    key = "distance_" + content_hash(_VERSION, mesh.vertices, mesh.faces, normals, *settings, *left_out)
    arrays = cached_arrays(key, lambda: {"distance": signed_distance_grid(mesh, *settings, *left_out)}, cache)
    return arrays["distance"]
