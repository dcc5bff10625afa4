"""From the visual hull to the smallest smooth surface whose silhouettes are still the masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.sparse.linalg import splu

from nerfro.data.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.visual_hull import Silhouettes

_ITERATIONS = 10
# Weights of area and of bending for each observation of the outline; found on silhouettes of a rounded cube.
_AREA, _BENDING = 1.1e-5, 4.4e-8
# The area's weight falls from this many times its last value: a surface that is a little too small is pulled out at the
# edges, where the object is, whereas one that fills the hull touches all masks everywhere and would stay.
_FIRST_AREA = 30.0
# Outlines farther than this from a mask's belong to folds of the surface in front of itself, pixels.
_GATE = 3.0
# Misfits below this are no news, pixels: where a line along the pixels' rows lies between two rows, a binary mask does
# not tell, and the surface may lie as it is smoothest.
_TOLERANCE_BINARY, _TOLERANCE_GREY = 0.25, 0.05
# Weight of observations within the tolerance, and misfit at which the weight of those beyond it is halved, pixels.
_WITHIN, _HALVED = 0.05, 0.7


@dataclass(frozen=True)
class _Rims:
    """Where the surface's outlines are seen: on edge (first, second) of the mesh, `share` of the way to second.

    Attributes:
        first, second: vertices.
        share: place between them.
        misfit: distance that the surface there has to move outwards to meet the mask's outline, world units.
        weight: of the observation.
    """

    first: Int[np.ndarray, "K"]
    second: Int[np.ndarray, "K"]
    share: Float[np.ndarray, "K"]
    misfit: Float[np.ndarray, "K"]
    weight: Float[np.ndarray, "K"]


def fit_surface(
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    smoothing: float = 1.0,
    progress: Callable[[float], None] = lambda share: None,
) -> TriangleMesh:
    """Move a hull's vertices along their normals so that its outlines meet the masks' and the rest is smooth.

    The hull is the largest body with the given silhouettes: its flat sides carry low roofs, where no camera looked
    along them, and every error of a mask cuts a groove. This is the smallest smooth one instead. Each step finds the
    rims (where the surface turns away from a camera), takes the outermost rim at each pixel of a mask's outline as an
    observation of the distance to it, and solves the linear least squares of observations, area and bending

        sum_k w_k (d_k - misfit_k)^2 + a sum_edges |x_i - x_j|^2 + b sum_i (h H_i)^2

    for the displacements d along the normals, x the displaced vertices, H their mean curvature, h the edges' length.

    Args:
        mesh: a closed surface around the object with triangles of about one size, such as marching cubes give.
        silhouettes: the masks.
        smoothing: multiplies the weights of area and bending; more for masks that were drawn by hand.
        progress: called with the share of the work that is done.

    Returns:
        The same triangles with other vertices.
    """
    faces, vertices = mesh.faces, mesh.vertices.copy()
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    size = float(np.ptp(vertices, axis=0).max())
    outlines = [_nearest_outline_pixel(mask) for mask in (silhouettes.masks > 0.5).numpy()]
    tolerance = _TOLERANCE_BINARY if _is_binary(silhouettes) else _TOLERANCE_GREY
    mean = _neighbour_mean(edges, len(vertices))
    across = _differences(edges, len(vertices))
    for iteration in range(_ITERATIONS):
        normals = _vertex_normals(vertices, faces)
        rims = _find_rims(vertices, normals, edges, silhouettes, outlines, tolerance)
        num_rims = len(rims.share)
        area = smoothing * num_rims * _AREA * _FIRST_AREA ** (1 - iteration / (_ITERATIONS - 1))
        bending = area * _BENDING / _AREA * size**2
        observed = sparse.csr_matrix(
            (
                np.concatenate([1 - rims.share, rims.share]),
                (np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])),
            ),
            (num_rims, len(vertices)),
        )
        curvature, curved = _mean_curvature(vertices, normals, edges, mean)
        along = [sparse.diags(normals[:, axis]) for axis in range(3)]
        stretch = sum(n @ across.T @ across @ n for n in along)
        stretched = sum(normals[:, a] * (across.T @ (across @ vertices[:, a])) for a in range(3))
        weights = sparse.diags(rims.weight)
        system = observed.T @ weights @ observed + area * stretch + bending * (curvature.T @ curvature)
        right = observed.T @ (rims.weight * rims.misfit) - area * stretched - bending * (curvature.T @ curved)
        # Symmetric and positive definite: no pivoting needed, and an ordering that keeps the factors sparse.
        factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        longest = 2 * np.sqrt(((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1).mean())
        vertices += factors.solve(right).clip(-longest, longest)[:, None] * normals
        progress((iteration + 1) / _ITERATIONS)
    return TriangleMesh(vertices, faces)


def _find_rims(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    silhouettes: Silhouettes,
    outlines: list[Int[np.ndarray, "H W"]],
    tolerance: float,
) -> _Rims:
    """The outermost rims that every view sees near each pixel of its mask's outline."""
    cameras = silhouettes.cameras
    parts = []
    for view, outline in enumerate(outlines):
        facing = (normals * (vertices - cameras.camera_to_world[view, :, 3].double().numpy())).sum(1)
        ends = facing[edges]
        turning = np.flatnonzero((ends[:, 0] > 0) != (ends[:, 1] > 0))
        share = ends[turning, 0] / (ends[turning, 0] - ends[turning, 1])
        first, second = edges[turning].T
        points = vertices[first] + share[:, None] * (vertices[second] - vertices[first])
        places = torch.from_numpy(points).float()
        inside, width = (values.double().numpy() for values in silhouettes.depth_inside(view, places)[:2])
        near = np.flatnonzero(np.abs(inside) < _GATE)
        cell = _look_up(outline, cameras.select([view]), places[near])
        order = np.lexsort((inside[near], cell))
        outermost = near[order[np.diff(cell[order], prepend=-1) != 0]]
        misfit = inside[outermost]
        news = misfit - misfit.clip(-tolerance, tolerance)
        weight = np.where(news == 0, _WITHIN, 1 / (1 + (misfit / _HALVED) ** 2))
        parts.append((first[outermost], second[outermost], share[outermost], news * width[outermost], weight))
    return _Rims(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _look_up(outline: Int[np.ndarray, "H W"], camera: Cameras, points: torch.Tensor) -> Int[np.ndarray, "P"]:
    pixels = camera.project(points)[0][0].numpy()
    row = pixels[:, 1].astype(np.int64).clip(0, camera.height - 1)
    column = pixels[:, 0].astype(np.int64).clip(0, camera.width - 1)
    return outline[row, column]


def _nearest_outline_pixel(inside: np.ndarray) -> Int[np.ndarray, "H W"]:
    """Number of the pixel of a mask's outline that is nearest to each pixel."""
    outline = inside & ~binary_erosion(inside, border_value=1)
    rows, columns = distance_transform_edt(~outline, return_distances=False, return_indices=True)
    return rows.astype(np.int64) * inside.shape[1] + columns


def _is_binary(silhouettes: Silhouettes) -> bool:
    """Whether the masks' pixels are covered or not, without shares in between."""
    masks = silhouettes.masks
    partial = ((masks > 0.02) & (masks < 0.98)).sum()
    changes = ((masks[:, 1:] > 0.5) != (masks[:, :-1] > 0.5)).sum()
    return int(partial) < 0.2 * int(changes)


def _vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Mean normals of the triangles around each vertex, weighted with their areas."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)]
    total = np.stack(sums, -1)
    return total / np.linalg.norm(total, axis=1, keepdims=True).clip(1e-12)


def _neighbour_mean(edges: Int[np.ndarray, "E 2"], num_vertices: int) -> sparse.csr_matrix:
    """Takes values at vertices to the mean of their neighbours'."""
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=num_vertices)
    return sparse.csr_matrix((1 / degree[both[:, 0]], (both[:, 0], both[:, 1])), (num_vertices, num_vertices))


def _differences(edges: Int[np.ndarray, "E 2"], num_vertices: int) -> sparse.csr_matrix:
    """Takes values at vertices to their differences along edges."""
    number = np.arange(len(edges))
    signs = np.repeat([1.0, -1.0], len(edges))
    return sparse.csr_matrix((signs, (np.tile(number, 2), edges.T.ravel())), (len(edges), num_vertices))


def _mean_curvature(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    mean: sparse.csr_matrix,
) -> tuple[sparse.csr_matrix, Float[np.ndarray, "V"]]:
    """Half the mean curvature at vertices times the edges' length: how displacements change it, and what it is now.

    The neighbours' mean lies off a vertex by r^2 H / 2 along the normal, r^2 the mean square of the edges' lengths.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    square = ((vertices[both[:, 0]] - vertices[both[:, 1]]) ** 2).sum(1)
    around = np.bincount(both[:, 0], square) / np.bincount(both[:, 0])
    typical = around.mean()
    # Marching cubes leave some triangles so small that their curvature is noise.
    scale = sparse.diags(np.sqrt(typical) / around.clip(0.05 * typical))
    umbrella = mean - sparse.identity(len(vertices))
    along = [sparse.diags(normals[:, axis]) for axis in range(3)]
    change = scale @ sum(n @ umbrella @ n for n in along)
    return change.tocsr(), scale @ (normals * (umbrella @ vertices)).sum(1)
