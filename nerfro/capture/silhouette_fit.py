"""From the visual hull to a smooth surface whose silhouettes are still the masks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.mesh import TriangleMesh


class _Prior(NamedTuple):
    """What is taken for likely where no outline tells.

    The last weights of area and bending for each observation of the outline are in units of the object's size. They
    fall from `first` times that: a surface that is too small is pulled out at the edges, where the object is, whereas
    one that fills the hull touches all masks everywhere and would stay.
    """

    area: float
    bending: float
    first: float
    usual: bool  # whether the curvature that is usual around a vertex is likely, or none
    iterations: int


_ROUND = _Prior(area=3e-5, bending=1e-7, first=1, usual=True, iterations=10)
_FLAT = _Prior(area=3e-6, bending=1e-8, first=100, usual=False, iterations=20)
# Flat sides and sharp edges are believed in if they bring the outlines so much nearer to the masks'. Over five scenes
# it was 0.26 and 0.64 times as near where they are true, and 0.94 to 1.2 where the object is round or masks are coarse.
_CONVINCING = 0.8
# A normal that is turned by a radian counts as far away as this share of the object's size. Curvature is usual around a
# vertex if this share of the vertices there have at least as much: 0 on flat sides and low roofs, the ball's on a ball.
_TURN, _LEAST_SHARE = 0.08, 0.7
# Around a vertex are so many of these, spread over the whole surface.
_NUM_AROUND, _NUM_SPREAD = 31, 1000
# A binary mask's outline is known to about this, pixels. The misfits' median over it, where that is more than 1, is how
# far the surface still is from the masks: the two limits below widen with it, so that it never loses them all.
_TYPICAL = 0.35
# Outlines farther than this from a mask's belong to folds of the surface in front of itself; where the weight of an
# observation is halved, pixels.
_GATE, _HALVED = 3.0, 0.7


class _Rims(NamedTuple):
    """Where the surface's outlines are seen: on edge (first, second) of the mesh, `share` of the way to second.

    To meet the mask's outline the surface has to move outwards by `misfit` there, world units.
    """

    first: Int[np.ndarray, "K"]
    second: Int[np.ndarray, "K"]
    share: Float[np.ndarray, "K"]
    misfit: Float[np.ndarray, "K"]
    weight: Float[np.ndarray, "K"]
    width: Float[np.ndarray, "K"]  # of a pixel there, world units


def fit_surface(
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    smoothing: float = 1.0,
    progress: Callable[[float], None] = lambda share: None,
) -> TriangleMesh:
    """Move a hull's vertices along their normals so that its outlines meet the masks' and the rest is smooth.

    The hull is the largest body with the given silhouettes: its flat sides carry low roofs, where no camera looked
    along them, and every error of a mask cuts a groove. This is a smooth one instead. Each step finds the rims (where
    the surface turns away from a camera), takes the outermost rim at each pixel of a mask's outline as an observation
    of the distance to it, and solves the linear least squares of observations, area and bending

        sum_k w_k (d_k - misfit_k)^2 + a (sum_edges |x_i - x_j|^2 - sum_i p_i d_i) + b sum_i (h (H_i - C_i))^2

    for the displacements d along the normals, x the displaced vertices, H their mean curvature, h the edges' length.
    C is the curvature that is usual around a vertex, and p the pressure at which area bends a film that much: a ball
    is left alone, where least area alone would draw it in between its rims. All of it is relative to the object's size
    and to the number of observations.

    That draws in sharp edges. So a second surface is fitted without C and p, with much area first and hardly any at
    last; it is taken where its outlines are clearly nearer to the masks'.

    The mesh is closed and has triangles of about one size, such as marching cubes give. `smoothing` multiplies the
    weights of area and bending; more of it suits masks that were drawn by hand. `progress` is told the share done.
    """
    count = itertools.count(1)

    def step() -> None:
        progress(next(count) / (_ROUND.iterations + _FLAT.iterations))

    outlines = [_nearest_outline_pixel(mask) for mask in (silhouettes.masks > 0.5).numpy()]
    rounded, rounded_misfit = _fit(mesh, silhouettes, outlines, smoothing, _ROUND, step)
    flat, flat_misfit = _fit(mesh, silhouettes, outlines, smoothing, _FLAT, step)
    return flat if flat_misfit < _CONVINCING * rounded_misfit else rounded


def rim_points(
    mesh: TriangleMesh, silhouettes: Silhouettes
) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K"], Float[Tensor, "K"]]:
    """Points of a surface that views see on the outlines of their masks.

    With them how far each had to move outwards to lie on it, and how wide a pixel is there; all in world units.
    """
    faces, vertices = mesh.faces, mesh.vertices
    outlines = [_nearest_outline_pixel(mask) for mask in (silhouettes.masks > 0.5).numpy()]
    rims = _find_rims(vertices, _vertex_normals(vertices, faces), _edges(faces), silhouettes, outlines)
    share = rims.share[:, None]
    points = (1 - share) * vertices[rims.first] + share * vertices[rims.second]
    first, second, third = (torch.from_numpy(values).float() for values in (points, rims.misfit, rims.width))
    return first, second, third


def _edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def _fit(
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    outlines: list[Int[np.ndarray, "H W"]],
    smoothing: float,
    prior: _Prior,
    step: Callable[[], None],
) -> tuple[TriangleMesh, float]:
    """The surface that is likeliest by a prior, and its outlines' mean distance from the masks', world units."""
    faces, vertices = mesh.faces, mesh.vertices.copy()
    edges = _edges(faces)
    size = float(np.ptp(vertices, axis=0).max())
    both, degree = np.concatenate([edges, edges[:, ::-1]]), np.bincount(edges.ravel())
    # These take values at vertices to the means of their neighbours', and to their differences along edges.
    mean = sparse.csr_matrix((1 / degree[both[:, 0]], (both[:, 0], both[:, 1])), (len(vertices),) * 2)
    signs, number = np.repeat([1.0, -1.0], len(edges)), np.tile(np.arange(len(edges)), 2)
    across = sparse.csr_matrix((signs, (number, edges.T.ravel())), (len(edges), len(vertices)))
    for iteration in range(prior.iterations):
        normals = _vertex_normals(vertices, faces)
        rims = _find_rims(vertices, normals, edges, silhouettes, outlines)
        num_rims = len(rims.share)
        # The last three steps have the last weights.
        more = prior.first ** max(0.0, 1 - iteration / (prior.iterations - 3))
        area = smoothing * num_rims * prior.area * more
        bending = smoothing * num_rims * prior.bending * more * size**2
        row, column = np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])
        shares = np.concatenate([1 - rims.share, rims.share])
        observed = sparse.csr_matrix((shares, (row, column)), (num_rims, len(vertices)))
        curvature, curved, around = _mean_curvature(vertices, normals, edges, mean)
        usual = _usual_curvature(curved, vertices, normals, _TURN * size) if prior.usual else np.zeros_like(curved)
        stretch = sum(n @ across.T @ across @ n for n in map(sparse.diags, normals.T))
        stretched = sum(normals[:, a] * (across.T @ (across @ vertices[:, a])) for a in range(3))
        pressure = -degree * around / np.sqrt(around.mean()) * usual
        weights = sparse.diags(rims.weight)
        system = observed.T @ weights @ observed + area * stretch + bending * (curvature.T @ curvature)
        right = observed.T @ (rims.weight * rims.misfit) - area * (stretched - pressure)
        right -= bending * (curvature.T @ (curved - usual))
        # Symmetric and positive definite: no pivoting needed, and an ordering that keeps the factors sparse.
        factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        longest = 2 * np.sqrt(((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1).mean())
        vertices += factors.solve(right).clip(-longest, longest)[:, None] * normals
        step()
    rims = _find_rims(vertices, _vertex_normals(vertices, faces), edges, silhouettes, outlines)
    return TriangleMesh(vertices, faces), float(np.abs(rims.misfit).mean())


def _find_rims(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    silhouettes: Silhouettes,
    outlines: list[Int[np.ndarray, "H W"]],
) -> _Rims:
    """The outermost rims that every view sees near each pixel of its mask's outline."""
    cameras = silhouettes.cameras
    spacing = float(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean())
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
        known = np.flatnonzero(np.isfinite(inside))
        if not len(known):
            continue
        # Pixels narrower than an edge may be met by no rim but one of a fold, so they are taken together.
        pixels = max(1, int(np.ceil(spacing / width[known].mean())))
        cell = _look_up(outline, cameras.select([view]), places[known], pixels)
        order = np.lexsort((inside[known], cell))
        outermost = known[order[np.diff(cell[order], prepend=-1) != 0]]
        parts.append((first[outermost], second[outermost], share[outermost], inside[outermost], width[outermost]))
    first, second, share, misfit, width = (np.concatenate(values) for values in zip(*parts, strict=True))
    spread = max(1.0, float(np.median(np.abs(misfit))) / _TYPICAL)
    near = np.abs(misfit) < _GATE * spread
    weight = 1 / (1 + (misfit / (_HALVED * spread)) ** 2)
    return _Rims(first[near], second[near], share[near], (misfit * width)[near], weight[near], width[near])


def _look_up(
    outline: Int[np.ndarray, "H W"], camera: Cameras, points: torch.Tensor, pixels: int
) -> Int[np.ndarray, "P"]:
    """Number of the square of pixels x pixels that holds the part of the outline nearest to each point."""
    place = camera.project(points)[0][0].numpy()
    row = place[:, 1].astype(np.int64).clip(0, camera.height - 1)
    column = place[:, 0].astype(np.int64).clip(0, camera.width - 1)
    nearest = outline[row, column]
    return nearest // camera.width // pixels * camera.width + nearest % camera.width // pixels


def _nearest_outline_pixel(inside: np.ndarray) -> Int[np.ndarray, "H W"]:
    """Number of the pixel of a mask's outline that is nearest to each pixel."""
    outline = inside & ~binary_erosion(inside, border_value=1)
    rows, columns = distance_transform_edt(~outline, return_distances=False, return_indices=True)
    return rows.astype(np.int64) * inside.shape[1] + columns


def _vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Mean normals of the triangles around each vertex, weighted with their areas."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)]
    total = np.stack(sums, -1)
    return total / np.linalg.norm(total, axis=1, keepdims=True).clip(1e-12)


def _mean_curvature(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    mean: sparse.csr_matrix,
) -> tuple[sparse.csr_matrix, Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Half the mean curvature at vertices times the edges' length, negative on a ball.

    Returns:
        How displacements change it, what it is now, and the mean square of the lengths of each vertex' edges.

    The neighbours' mean lies off a vertex by r^2 H / 2 along the normal, r^2 the mean square of the edges' lengths.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    square = ((vertices[both[:, 0]] - vertices[both[:, 1]]) ** 2).sum(1)
    around = np.bincount(both[:, 0], square) / np.bincount(both[:, 0])
    typical = around.mean()
    # Marching cubes leave some triangles so small that their curvature is noise.
    scale = sparse.diags(np.sqrt(typical) / around.clip(0.05 * typical))
    umbrella = mean - sparse.identity(len(vertices))
    change = scale @ sum(n @ umbrella @ n for n in map(sparse.diags, normals.T))
    return change.tocsr(), scale @ (normals * (umbrella @ vertices)).sum(1), around


def _usual_curvature(
    curved: Float[np.ndarray, "V"], vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"], turn: float
) -> Float[np.ndarray, "V"]:
    """The curvature (negative on a ball) that most vertices around each one reach, with the sign of their median.

    A normal turned by a radian is `turn` away: the other side of a thin wall is not near.
    """
    points = np.concatenate([vertices, turn * normals], 1)
    chosen = np.linspace(0, len(points) - 1, min(len(points), _NUM_SPREAD)).astype(np.int64)
    _, index = cKDTree(points[chosen]).query(points, k=min(_NUM_AROUND, len(chosen)))
    near = curved[chosen][index]
    sign = np.sign(np.median(near, axis=1))
    return sign * np.quantile((near * sign[:, None]).clip(min=0), 1 - _LEAST_SHARE, axis=1)
