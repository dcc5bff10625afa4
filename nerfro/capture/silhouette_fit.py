"""From the visual hull to a smooth surface whose silhouettes are still the masks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.capture.surroundings import HELD_BACK
from nerfro.capture.visual_hull import Silhouettes
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh

# For each view the number of the outline's pixel that is nearest to each of its pixels.
_Outlines: TypeAlias = "dict[int, Int[np.ndarray, 'H W']]"


class _Prior(NamedTuple):
    """What is taken for likely where no outline tells.

    Weights of area and bending are for each observation of the outline, in units of the object's size, and are
    multiplied by a strength that falls step by step: a surface that is too small is pulled out at the edges, where the
    object is, whereas one that fills the hull touches all masks everywhere and would stay.
    """

    area: float
    bending: float
    first: float  # strength of the first step
    last: float
    usual: bool  # whether the curvature that is usual around a vertex is likely, or none
    edge: float  # curvature, see `_mean_curvature`, beyond which area and bending cost less: an edge is no error


# Chosen on the scenes `torus` and `ship`, with masks of shares.
_ROUND = _Prior(area=3e-6, bending=1e-5, first=100, last=0.01, usual=True, edge=np.inf)
_FLAT = _Prior(area=3e-6, bending=5e-9, first=100, last=0.1, usual=False, edge=0.02)
# Steps of falling strength, and steps after them, with all views, of the strength that was best.
_STEPS, _LAST_STEPS = 22, 3
# The strongest is taken whose outlines are at most so many times as far from the masks' as the nearest: noise of masks
# tilts a surface before it moves its outlines.
_AS_GOOD = 1.1
# How far vertices move to the middle of their neighbours, along the surface.
_SPREADING = 0.5
# A normal that is turned by a radian counts as far away as this share of the object's size. Curvature is usual around a
# vertex if this share of the vertices there have at least as much: 0 on flat sides and low roofs, the ball's on a ball.
_TURN, _LEAST_SHARE = 0.08, 0.7
# Around a vertex are so many of these, spread over the whole surface.
_NUM_AROUND, _NUM_SPREAD = 31, 1000
# A binary mask's outline is known to about this, pixels. The misfits' median over it is how far the surface still is
# from the masks: the two limits below widen with it, so that it never loses them all.
_TYPICAL = 0.35
# Outlines farther than this from a mask's belong to folds of the surface in front of itself; where the weight of an
# observation is halved, pixels. That falls to this share of it for masks of shares, which are surer than binary ones.
_GATE, _HALVED, _SUREST = 3.0, 0.7, 0.3


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
    view: Int[np.ndarray, "K"]  # that sees it


class RimPoints(NamedTuple):
    """Points of a surface that views see on the outlines of their masks; lengths in world units."""

    points: Float[Tensor, "K 3"]
    normals: Float[Tensor, "K 3"]  # unit, outwards
    misfits: Float[Tensor, "K"]  # how far each has to move outwards to lie on the outline
    weights: Float[Tensor, "K"]  # of these: less where most others are nearer
    widths: Float[Tensor, "K"]  # of a pixel there
    views: Int[Tensor, "K"]


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

    That draws in sharp edges. So a second surface is fitted without C and p, whose area and bending cost less where it
    is bent much. Views that are held back decide between the two, and how strong area and bending are: the surer the
    masks, the weaker.

    The mesh is closed and has triangles of about one size, such as marching cubes give. `smoothing` multiplies the
    strength that was found; more of it suits masks that were drawn by hand. `progress` is told the share done.
    """
    count = itertools.count(1)

    def step() -> None:
        progress(next(count) / (2 * _STEPS + _LAST_STEPS))

    fit, outlines = _Fit(mesh, silhouettes), _outlines(silhouettes)
    found = [fit.search(prior, outlines, step) for prior in (_ROUND, _FLAT)]
    best = min(found, key=lambda each: each.misfit)
    vertices = best.vertices
    for left in reversed(range(_LAST_STEPS)):
        vertices = fit.moved(vertices, outlines, best.prior, smoothing * best.strength, spread=left > 0)
        step()
    return TriangleMesh(vertices, mesh.faces)


class RimFinder:
    """Where views see the outlines of a surface that are near those of their masks.

    What does not depend on the cameras is prepared once, for those that move.
    """

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes) -> None:
        self._vertices, self._edges = mesh.vertices, _edges(mesh.faces)
        self._normals = _vertex_normals(mesh.vertices, mesh.faces)
        self._silhouettes, self._outlines = silhouettes, _outlines(silhouettes)

    def points(self, cameras: Cameras | None = None) -> RimPoints:
        """With other cameras than the silhouettes', if they are given."""
        silhouettes = self._silhouettes if cameras is None else replace(self._silhouettes, cameras=cameras)
        rims = _find_rims(self._vertices, self._normals, self._edges, silhouettes, self._outlines)
        normals = self._along_edges(self._normals, rims)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return RimPoints(
            points=_tensor(self._along_edges(self._vertices, rims)),
            normals=_tensor(normals),
            misfits=_tensor(rims.misfit),
            weights=_tensor(rims.weight),
            widths=_tensor(rims.width),
            views=torch.from_numpy(rims.view),
        )

    @staticmethod
    def _along_edges(values: Float[np.ndarray, "V 3"], rims: _Rims) -> Float[np.ndarray, "K 3"]:
        share = rims.share[:, None]
        return (1 - share) * values[rims.first] + share * values[rims.second]


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values).float()


def _outlines(silhouettes: Silhouettes) -> _Outlines:
    return {view: _nearest_outline_pixel(mask) for view, mask in enumerate((silhouettes.masks > 0.5).numpy())}


def _edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


class _Found(NamedTuple):
    """The surface of one prior with which views that were held back agree best, and its mean misfit there."""

    prior: _Prior
    strength: float
    vertices: Float[np.ndarray, "V 3"]
    misfit: float


class _Fit:
    """What all steps of a fit share: the triangles and the views."""

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes) -> None:
        self.start, self.faces, self.silhouettes = mesh.vertices, mesh.faces, silhouettes
        self.edges = edges = _edges(mesh.faces)
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self.degree = np.bincount(edges.ravel())
        both, num_vertices = np.concatenate([edges, edges[:, ::-1]]), len(mesh.vertices)
        # These take values at vertices to the means of their neighbours', and to their differences along edges.
        shape = (num_vertices, num_vertices)
        self.mean = sparse.csr_matrix((1 / self.degree[both[:, 0]], (both[:, 0], both[:, 1])), shape)
        signs, number = np.repeat([1.0, -1.0], len(edges)), np.tile(np.arange(len(edges)), 2)
        self.across = sparse.csr_matrix((signs, (number, edges.T.ravel())), (len(edges), num_vertices))

    def search(self, prior: _Prior, outlines: _Outlines, step: Callable[[], None]) -> _Found:
        """Fit with a prior that becomes weaker and weaker; views that are held back tell the best strength."""
        judging = range(HELD_BACK - 1, len(outlines), HELD_BACK) or [len(outlines) - 1]
        judges = {view: outlines[view] for view in judging}
        teachers = {view: outline for view, outline in outlines.items() if view not in judges}
        vertices, found = self.start, []
        for strength in np.geomspace(prior.first, prior.last, _STEPS).tolist():
            vertices = self.moved(vertices, teachers, prior, strength)
            misfit = float(np.abs(self.rims(vertices, judges).misfit).mean())
            found.append(_Found(prior, strength, vertices, misfit))
            step()
        enough = _AS_GOOD * min(each.misfit for each in found)
        return next(each for each in found if each.misfit <= enough)

    def rims(self, vertices: Float[np.ndarray, "V 3"], outlines: _Outlines) -> _Rims:
        """Where views see the outlines of a surface."""
        return _find_rims(vertices, _vertex_normals(vertices, self.faces), self.edges, self.silhouettes, outlines)

    def moved(
        self,
        vertices: Float[np.ndarray, "V 3"],
        outlines: _Outlines,
        prior: _Prior,
        strength: float,
        spread: bool = True,
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices after a step. `spread`: also along the surface, so that triangles become alike.

        Small and large ones side by side, as marching cubes leave them, have a mean of neighbours that says more about
        the triangles than about the curvature.
        """
        normals, rims = _vertex_normals(vertices, self.faces), self.rims(vertices, outlines)
        num_rims = len(rims.share)
        area = strength * num_rims * prior.area
        bending = strength * num_rims * prior.bending * self.size**2
        row, column = np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])
        shares = np.concatenate([1 - rims.share, rims.share])
        observed = sparse.csr_matrix((shares, (row, column)), (num_rims, len(vertices)))
        curvature, curved, around = _mean_curvature(vertices, normals, self.edges, self.mean)
        usual = _usual_curvature(curved, vertices, normals, _TURN * self.size) if prior.usual else 0 * curved
        bent = np.abs(curved - usual)
        # What is bent while the prior is still strong may be the roofs that it shall level.
        edge = prior.edge * max(1.0, strength)
        stiff = 1 / np.hypot(1, 0.5 * (bent + self.mean @ bent) / edge)
        stiffness, tension = sparse.diags(stiff), self.across.T @ sparse.diags(stiff[self.edges].prod(1)) @ self.across
        stretch = sum(n @ tension @ n for n in map(sparse.diags, normals.T))
        stretched = sum(normals[:, a] * (tension @ vertices[:, a]) for a in range(3))
        pressure = -self.degree * around / np.sqrt(around.mean()) * usual
        system = observed.T @ sparse.diags(rims.weight) @ observed + area * stretch
        system += bending * (curvature.T @ stiffness @ curvature)
        right = observed.T @ (rims.weight * rims.misfit) - area * (stretched - pressure)
        right -= bending * (curvature.T @ (stiffness @ (curved - usual)))
        # Symmetric and positive definite: no pivoting needed, and an ordering that keeps the factors sparse.
        factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        ends = vertices[self.edges]
        longest = 2 * np.sqrt(((ends[:, 0] - ends[:, 1]) ** 2).sum(1).mean())
        vertices = vertices + factors.solve(right).clip(-longest, longest)[:, None] * normals
        if spread:
            normals = _vertex_normals(vertices, self.faces)
            towards = self.mean @ vertices - vertices
            vertices = vertices + _SPREADING * (towards - (towards * normals).sum(1, keepdims=True) * normals)
        return vertices


def _find_rims(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    silhouettes: Silhouettes,
    outlines: _Outlines,
) -> _Rims:
    """The outermost rims that every view sees near each pixel of its mask's outline."""
    cameras = silhouettes.cameras
    spacing = float(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean())
    parts = []
    for view, outline in outlines.items():
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
        of_view = np.full(len(outermost), view)
        chosen = (values[outermost] for values in (first, second, share, inside, width))
        parts.append((*chosen, of_view))
    if not parts:
        raise NerfroError("no view sees the surface where it looks; surface, poses and masks do not belong together")
    first, second, share, misfit, width, views = (np.concatenate(values) for values in zip(*parts, strict=True))
    spread = float(np.median(np.abs(misfit))) / _TYPICAL
    near = np.abs(misfit) < _GATE * max(1.0, spread)
    weight = 1 / (1 + (misfit / (_HALVED * max(_SUREST, spread))) ** 2)
    return _Rims(*(each[near] for each in (first, second, share, misfit * width, weight, width, views)))


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
