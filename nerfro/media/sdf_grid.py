"""Homogeneous bodies made of meshes, as signed distances on a grid with a continuous gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from nerfro.allowed import NotNegative, Positive, Range, Resolution
from nerfro.errors import NerfroError
from nerfro.files.cache import cached_arrays, content_hash
from nerfro.geometry.bodies import require_separate
from nerfro.geometry.interpolation import quadratic_spline, smooth, spline_coefficients
from nerfro.geometry.intersection import MeshIntersector, Triangles
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.kernels.available import require_bytes
from nerfro.kernels.constants import constant
from nerfro.media.base import Scalars, Vectors, lazy_buffer
from nerfro.media.solid import Solid
from nerfro.media.voxel_grid import BYTES_A_VERTEX, check_margin, grid_box
from nerfro.paths import resolve_path
from nerfro.registry import register
from nerfro.variants import variant

# Voxels of air around the object, where its box is not given.
AIR = 4

# Voxels around the surface in which the distance is exact: the spline's support and the step that finds the surface.
BAND = 3.0
# Cells a side of the blocks in which bent rays look up how far they may jump before they look up distances themselves,
# and of those in which straight runs look up where a surface may be.
BLOCK, SURFACE_BLOCK = 4, 3
# A quadratic spline that is continued by half a cell at a corner is a sum of coefficients whose weights are 2.19 and
# -1.19 together: it is above 0 where the largest coefficient is less than 1.84 times the least.
_CONTINUED = 1.8
# Part of the cache's key: raise it when the same mesh and settings give other distances than before.
_VERSION = 3


@register("medium", "sdf_grid")
class SdfGrid(Solid):
    """Bodies of constant index with the surfaces of meshes; thin shell for eikonal, sharp surface for snell.

    Args:
        mesh: closed triangle mesh of the outer body, world units, any format trimesh reads.
        ior: refractive index inside the mesh.
        inner_meshes: bodies inside it (a liquid, a bubble), each inside those before; opaque things do not belong
            here, because rays do not bend on them.
        inner_iors: their refractive indices.
        learn_ior: refine all indices in training, by the replay of paths.
        resolution: grid vertices a side.
        box_min, box_max: corners of the grid, world units; none for the mesh's bounds and a margin of air.
        shell_voxels: half width of the smooth interface that the Eikonal equation sees, voxels.
        crease_degrees: edges with larger angles between their faces stay sharp.
        smoothing_size, smoothing_sigma: Gaussian taps a side and standard deviation (voxels) that the distance is
            smoothed with, for noisy silhouette hulls; size 0 for none. The kernel is of fourth order: it flattens
            noise and keeps curvature.
        accept_open_mesh: take meshes with holes; the majority of three axes decides what is inside.
        absorption, learn_absorption, abbe: tint and dispersion, see `Solid`; for snell alone.
        cache: keep the distances in the cache folder.

    Attributes:
        meshes: the surfaces themselves; empty where the medium was made of distances.
    """

    distances: Float[Tensor, "K X Y Z"]  # signed distance of each body at the grid's vertices
    coefficients: Float[Tensor, "K X Y Z"]  # of the quadratic B-splines through them
    # Where the meshes' vertices are now, one mesh after another, world units; a parameter where the triangles are
    # learned.
    vertices: Float[Tensor, "V 3"]
    _traced: tuple[Tensor, int, Triangles, MeshIntersector] | None = None

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
        crease_degrees: NotNegative = 30.0,
        smoothing_size: Annotated[int, Range(at_least=0, at_most=99)] = 0,
        smoothing_sigma: Positive = 1.0,
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
        require_bytes(BYTES_A_VERTEX * resolution**3, f"medium.resolution={resolution}")
        meshes = [load_mesh(resolve_path(path), accept_open_mesh) for path in (mesh, *inner_meshes)]
        box = grid_box(box_min, box_max, meshes, resolution, AIR + smoothing_size // 2)
        spacing = (box[1] - box[0]) / (resolution - 1)
        shell = shell_voxels * float(spacing.min())
        super().__init__([ior, *inner_iors], shell, absorption, learn_absorption, abbe, learn_ior)
        self.crease_degrees = crease_degrees
        self.meshes = meshes
        band = BAND + smoothing_size
        distances = []
        for body in self.meshes:
            check_margin(body, box, resolution, 2)
            if body.is_closed:
                require_separate(body)
            distances.append(cached_distance(body, box, resolution, band, crease_degrees, cache))
        values = torch.from_numpy(np.stack(distances))
        if smoothing_size:
            # 2 G - G * G: the curvature's share of the blur cancels.
            values = torch.stack([smooth(2 * v - smooth(v, smoothing_size, smoothing_sigma), smoothing_size,
                                         smoothing_sigma) for v in values])  # fmt: skip
        self._set(values, torch.from_numpy(box).float())

    @classmethod
    def from_distances(
        cls,
        distances: Float[Tensor, "K X Y Z"],
        box: Float[Tensor, "2 3"],
        iors: Sequence[float],
        shell: float,
        **glass: Any,
    ) -> SdfGrid:
        """Make the medium of given signed distances.

        They are of each body at the vertices of a grid over `box`, negative inside and positive at the border; `glass`
        is what else `Solid` takes.
        """
        medium = cls.__new__(cls)
        Solid.__init__(medium, iors, shell, **glass)
        medium.meshes = []
        medium._set(distances, box)
        return medium

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the outer mesh; the grid's box where there is none."""
        return torch.from_numpy(self.meshes[0].bounds).float() if self.meshes else self.box

    @property
    def spacing(self) -> Float[Tensor, "3"]:
        """Distance between neighbouring vertices, world units."""
        return (self.box[1] - self.box[0]) / (constant(self.distances.shape[1:], self.box.device) - 1)

    def grown(self, outwards: Float[Tensor, "X Y Z"]) -> SdfGrid:
        """The same glass with its outer surface moved outwards by so much at the grid's vertices, world units.

        It is made of distances, which are exact near the surface as long as that has not moved far.
        """
        return self._of_distances(torch.cat([self.distances[:1] - outwards, self.distances[1:]]), meshes=[])

    def _of_distances(self, distances: Float[Tensor, "K X Y Z"], **changes: Any) -> Any:
        changed = variant(self, **changes)
        changed._forget_bounds()
        changed._set(distances, self.box)
        return changed

    def _forget_bounds(self) -> None:
        """Of the surfaces as they were."""
        for name in ("_coarse_clearance", "_coarse_slopes", "_empty_blocks"):
            self._buffers.pop(name, None)

    def at_wavelength(self, wavelength: float) -> SdfGrid:
        self.coarse_clearance, self.coarse_slopes, self.empty_blocks  # noqa: B018 (made before they are shared)
        return super().at_wavelength(wavelength)

    @torch.no_grad()
    def traced_triangles(self) -> tuple[Triangles, MeshIntersector]:
        """The triangles without gradients, and what finds those that rays hit; made anew when `vertices` have moved."""
        known = self._traced
        if known is None or known[0] is not self.vertices or known[1] != self.vertices._version:
            triangles = self.triangles()
            known = self.vertices, self.vertices._version, triangles, MeshIntersector(triangles.corners)
            self._traced = known
        return known[2:]

    def triangles(self) -> Triangles:
        """The triangles of all meshes where `vertices` are now, with gradients by them."""
        return Triangles.of(self.meshes, self.crease_degrees, self.vertices)

    @lazy_buffer
    def coarse_clearance(self) -> Float[Tensor, "x y z"]:
        """Lower bound of the distance to all surfaces from any point of each block of `BLOCK`^3 cells, world units."""
        blocks = torch.tensor(self.coefficients.shape[1:]).sub(1).div(BLOCK, rounding_mode="floor").add(1).tolist()
        nearest = self.distances.abs().amin(0).cpu()
        for axis, count in enumerate(blocks):
            # Neighbouring blocks share the vertices between them.
            last = torch.arange(count * BLOCK + 1).clamp(max=nearest.shape[axis] - 1)
            nearest = nearest.index_select(axis, last).unfold(axis, BLOCK + 1, BLOCK).amin(-1)
        spacing = self.spacing.cpu()
        # A point is within half a cell's diagonal of a vertex; the spline's surface is a little off the data's.
        margin = 0.5 * torch.linalg.vector_norm(spacing) + 0.25 * spacing.min()
        return (nearest - margin).clamp(min=0).to(self.distances.device)

    @lazy_buffer
    def coarse_slopes(self) -> Float[Tensor, "K x y z 3 2"]:
        """Lowest and highest derivative of each body's spline along the axes in each block of `SURFACE_BLOCK`^3 cells.

        A derivative is a mean of differences of neighbouring coefficients, so that these bound it. Nothing bounds it
        at the grid's border, where splines are continued.
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
        """How many blocks of `SURFACE_BLOCK`^3 cells away, along the axes or diagonally, a surface may be at least.

        0 where one may be in the block itself: a spline's values lie between its coefficients, so that there is none
        where these have one sign. At the grid's border, where splines are continued, they may not lie between them.
        """
        lowest, highest = _extremes(self._coefficients_of_blocks(), [SURFACE_BLOCK + 3] * 3)
        outside = lowest > torch.where(self._border_blocks(), highest / _CONTINUED, 0)
        empty = (outside | ((highest < 0) & ~self._border_blocks())).all(0)
        return torch.from_numpy(distance_transform_cdt(empty.numpy(), "chessboard").clip(0, 255).astype(np.uint8))

    def _coefficients_of_blocks(self) -> Float[Tensor, "K X Y Z"]:
        """Coefficients from one before each block of `SURFACE_BLOCK`^3 cells to one after it; on the CPU."""
        values = self.coefficients.detach().cpu()
        for axis, count in enumerate(values.shape[1:], start=1):
            blocks = (count - 1) // SURFACE_BLOCK + 1
            values = values.index_select(axis, torch.arange(-1, blocks * SURFACE_BLOCK + 2).clamp(0, count - 1))
        return values

    def _border_blocks(self) -> Bool[Tensor, "x y z"]:
        """Blocks of `SURFACE_BLOCK`^3 cells in which splines are continued beyond the grid."""
        axes = []
        for count in self.coefficients.shape[1:]:
            block = torch.arange((count - 1) // SURFACE_BLOCK + 1)
            axes.append((block == 0) | ((block + 1) * SURFACE_BLOCK > count - 2))
        x, y, z = axes
        return x[:, None, None] | y[:, None] | z

    def clearance(self, positions: Vectors) -> Scalars:
        """Distance to the nearest shell: a lower bound from the blocks, or where that is none the distance itself."""
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
        # Grids are made of the mesh at every start and do not belong in checkpoints.
        self.register_buffer("box", box, persistent=False)
        vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in self.meshes)])
        self.register_buffer("vertices", torch.from_numpy(vertices), persistent=False)
        coefficients = torch.stack([spline_coefficients(values) for values in distances])
        self.register_buffer("coefficients", coefficients, persistent=False)
        self.register_buffer("distances", distances, persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Splines of the distances and their exact gradients."""
        splines = [quadratic_spline(coefficients, self.box, positions) for coefficients in self.coefficients]
        return torch.stack([phi for phi, _ in splines], -1), torch.stack([gradient for _, gradient in splines], -2)


def _extremes(values: Float[Tensor, "K X Y Z"], windows: list[int]) -> tuple[Tensor, Tensor]:
    """Lowest and highest value [K, x, y, z] in windows of so many places along each axis, `SURFACE_BLOCK` apart."""
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
    crease_degrees: float,
    cache: bool,
    lid: Bool[np.ndarray, "F"] | None = None,
) -> Float[np.ndarray, "X Y Z"]:
    """Signed distance to a mesh at a grid's vertices, see `signed_distance_grid`, from the cache folder if it may."""
    normals = "none" if mesh.normals is None else mesh.normals
    settings = box, resolution, band, crease_degrees
    left_out = () if lid is None else (lid,)
    key = "distance_" + content_hash(_VERSION, mesh.vertices, mesh.faces, normals, *settings, *left_out)
    arrays = cached_arrays(key, lambda: {"distance": signed_distance_grid(mesh, *settings, *left_out)}, cache)
    return arrays["distance"]
