"""Fit of a smooth surface to silhouettes, starting from the visual hull."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.creases import CURVED, FACETS, STEPS, Sides, has_creases, sharpened
from nerfro.silhouettes.moving_mesh import MovingMesh, solve_symmetric
from nerfro.silhouettes.pixel_sides import by_pixel_sides
from nerfro.silhouettes.rims import Outlines, Rims, find_rims, outlines_of
from nerfro.silhouettes.silhouettes import VALIDATION_EVERY, is_antialiased
from nerfro.silhouettes.visual_hull import Silhouettes


class _Prior(NamedTuple):
    """Regularization of the surface.

    The weights are relative to one observation of the outline, in units of the object's size. They are multiplied by a
    strength that decreases during the fit, because a surface that starts too small is pulled outwards to the true
    contours, whereas the visual hull already touches all outlines and would not move.
    """

    area: float
    bending: float
    first: float  # initial strength
    last: float  # final strength
    typical_curvature: bool  # whether bending is relative to the typical curvature around a vertex, or to zero
    edge: float  # curvature (see `_mean_curvature`) above which the weights decrease, because it belongs to an edge
    steady: float  # weight of changes of curvature in the last steps, per squared misfit


# Chosen on the scenes `torus` and `ship` with antialiased masks.
_ROUND = _Prior(area=3e-6, bending=1e-5, first=100, last=0.01, typical_curvature=True, edge=np.inf, steady=0)
_FLAT = _Prior(area=3e-6, bending=5e-9, first=100, last=0.1, typical_curvature=False, edge=0.02, steady=4)
# Number of steps with decreasing strength, and of final steps with all views and the selected strength.
_STEPS, _LAST_STEPS = 22, 6
# Binary masks: number of final steps with the probit model of pixels, factor of the strength for these steps, and mean
# contour error in pixels above which masks count as inaccurate. Exact masks have 0.10 to 0.16, and masks displaced in
# waves by half a pixel 0.28.
_PROBIT_STEPS, _PROBIT_STRENGTH, _MAX_PROBIT_ERROR = 14, 0.3, 0.2
# Factor of bending in steps that also penalize changes of curvature: strong bending would round the edges.
_REDUCED_BENDING = 0.1
# Estimation of the direction of largest curvature: number of blurs, turn between neighbours in radians below which the
# direction is undefined, and exponent by which changes of curvature across an edge are discounted.
_BLURS, _MIN_TURN, _SHARPNESS = 4, np.radians(0.5), 4
# The strongest prior is selected whose validation error is within this factor of the smallest: noise in the masks tilts
# the surface before it increases the contour error.
_TOLERANCE = 1.1
# Distance that corresponds to normals one radian apart, as a fraction of the object's size. The typical curvature
# around a vertex is exceeded by this fraction of its neighbours: 0 on flat sides, the ball's curvature on a ball.
_NORMAL_DISTANCE, _MIN_EXCEEDING = 0.08, 0.7
# Number of neighbours of a vertex, chosen from so many vertices spread over the surface.
_NUM_NEIGHBOURS, _NUM_SPREAD = 31, 1000


def fit_surface(
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    smoothing: float = 1.0,
    progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """Fit a smooth surface whose contours meet the outlines of the masks.

    The visual hull is the largest body with the given silhouettes. It has low roofs on flat sides that no camera sees
    edge-on, and a groove for every error of a mask. The fit moves the vertices of the hull along their normals. Each
    step finds the contour points of the surface in all views, and solves the linear least-squares problem

        sum_k w_k (d_k - misfit_k)^2 + a (sum_edges |x_i - x_j|^2 - sum_i p_i d_i) + b sum_i (h (H_i - C_i))^2

    for the displacements d along the normals, with the displaced vertices x, the mean curvature H and the edge length
    h. C is the typical curvature around a vertex, and p is the pressure that balances the area term at this curvature:
    without C and p, a ball would shrink between its contours. All weights are relative to the object's size and to the
    number of observations.

    This prior rounds sharp edges. Therefore a second surface is fitted without C and p, and with smaller weights at
    vertices of large curvature. Validation views select between the two surfaces, and select the strength of the prior.

    If the second surface is selected, the last steps replace most of the bending term by

        g sum_edges w_ij (h (H_i - H_j))^2

    where w decreases from 1 along the direction of smallest curvature to 0 across it, so that an edge keeps one profile
    along its length and flat sides stay flat. The weight g is proportional to the squared mean misfit, an estimate of
    the noise of the masks. The validation error would not be one: with few views it contains what they do not show.

    For accurate binary masks, the last steps use the probit model of `by_pixel_sides`. If the second surface has
    creases, two variants with sharp edges are made (see `sharpened`), and validation views select among all surfaces.

    Args:
        mesh: closed mesh with triangles of similar size, as marching cubes produces.
        silhouettes: silhouettes of the object.
        smoothing: factor of the selected strength; larger values suit masks drawn by hand.
        progress: called with the completed fraction.
    """
    count, total = itertools.count(1), 2 * _STEPS + _LAST_STEPS

    def step() -> None:
        progress(next(count) / total)

    fit, outlines = _Fit(mesh, silhouettes), outlines_of(silhouettes)
    found = [fit.search(prior, outlines, step) for prior in (_ROUND, _FLAT)]
    if has_creases(fit.mesh.geometry(found[1].vertices)):
        total = 2 * _STEPS + 3 * STEPS
        facets, curved = (fit.with_creases(found[1], sides, outlines, step) for sides in (FACETS, CURVED))
        found.append(facets if facets.misfit <= _TOLERANCE * curved.misfit else curved)
    best = min(found, key=lambda each: each.misfit)
    vertices = best.vertices
    if best.sides is not None:
        sides = best.sides._replace(flat=smoothing * best.sides.flat)
        return TriangleMesh(fit.sharpened(vertices, sides, outlines, step), mesh.faces)
    strength, last_steps = smoothing * best.strength, _LAST_STEPS
    contour_error = fit.binary_mask_error(vertices, outlines)
    if contour_error is not None:
        strength, last_steps = _PROBIT_STRENGTH * strength, _PROBIT_STEPS
        total += _PROBIT_STEPS - _LAST_STEPS
    steady = strength / best.strength * best.prior.steady * (fit.misfit(vertices, outlines) / fit.size) ** 2
    for left in reversed(range(last_steps)):
        vertices = fit.moved(vertices, outlines, best.prior, strength, steady, contour_error, spread=left > 0)
        step()
    return TriangleMesh(vertices, mesh.faces)


class _Found(NamedTuple):
    """The surface of one prior with the smallest validation error, and this error (mean misfit in world units)."""

    prior: _Prior
    strength: float
    vertices: Float[np.ndarray, "vertices 3"]
    misfit: float
    sides: Sides | None = None  # prior of the sides, for a surface with sharp edges


class _Fit:
    """Mesh connectivity and views of a fit."""

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes) -> None:
        self.start, self.mesh, self.silhouettes = mesh.vertices, MovingMesh(mesh.faces), silhouettes
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self.edges = edges = self.mesh.edges
        self.degree = np.bincount(edges.ravel())
        # Sparse matrix that maps values at vertices to differences along edges.
        signs, number = np.repeat([1.0, -1.0], len(edges)), np.tile(np.arange(len(edges)), 2)
        self.across = sparse.csr_matrix((signs, (number, edges.T.ravel())), (len(edges), len(mesh.vertices)))

    def search(self, prior: _Prior, outlines: Outlines, step: Callable[[], None]) -> _Found:
        """Fit with decreasing strength of the prior, and select the strength by validation views."""
        training, validation = _split_views(outlines)
        vertices, found = self.start, []
        for strength in np.geomspace(prior.first, prior.last, _STEPS).tolist():
            vertices = self.moved(vertices, training, prior, strength)
            found.append(_Found(prior, strength, vertices, self.misfit(vertices, validation)))
            step()
        limit = _TOLERANCE * min(each.misfit for each in found)
        return next(each for each in found if each.misfit <= limit)

    def with_creases(self, blunt: _Found, sides: Sides, outlines: Outlines, step: Callable[[], None]) -> _Found:
        """Sharpen the edges of a surface, and compute the validation error of the result."""
        training, validation = _split_views(outlines)
        vertices = self.sharpened(blunt.vertices, sides, training, step)
        return blunt._replace(vertices=vertices, misfit=self.misfit(vertices, validation), sides=sides)

    def sharpened(
        self, vertices: Float[np.ndarray, "vertices 3"], sides: Sides, outlines: Outlines, step: Callable[[], None]
    ) -> Float[np.ndarray, "vertices 3"]:
        """Move the vertices until edges are sharp (see `creases.sharpened`)."""
        return sharpened(vertices, self.mesh, lambda moved: self.rims(moved, outlines), sides, step)

    def rims(self, vertices: Float[np.ndarray, "vertices 3"], outlines: Outlines) -> Rims:
        """Find the contour points of a surface with the given vertices."""
        return find_rims(self.mesh.geometry(vertices), self.silhouettes, outlines)

    def misfit(self, vertices: Float[np.ndarray, "vertices 3"], outlines: Outlines) -> float:
        """Compute the mean distance of the contour points to the outlines of the masks, in world units."""
        return float(np.abs(self.rims(vertices, outlines).misfit).mean())

    def binary_mask_error(self, vertices: Float[np.ndarray, "vertices 3"], outlines: Outlines) -> float | None:
        """Compute the mean contour error in pixels for accurate binary masks; None for other masks."""
        if is_antialiased(self.silhouettes.masks.numpy(), self.silhouettes.distances.numpy()):
            return None
        rims = self.rims(vertices, outlines)
        contour_error = float(np.abs(rims.misfit / rims.width).mean())
        return contour_error if contour_error < _MAX_PROBIT_ERROR else None

    def moved(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        outlines: Outlines,
        prior: _Prior,
        strength: float,
        steady: float = 0.0,
        contour_error: float | None = None,
        spread: bool = True,
    ) -> Float[np.ndarray, "vertices 3"]:
        """Make one least-squares step and return the new vertices.

        Args:
            vertices: current vertices.
            outlines: outlines of the views that are used.
            prior: regularization.
            strength: factor of the area and bending terms.
            steady: weight of changes of curvature, relative to one observation.
            contour_error: mean contour error in pixels, for the probit model of binary masks; None uses distances.
            spread: also equalize the triangles by tangential motion. For adjacent small and large triangles, as
                marching cubes produces, the mean of the neighbours is a poor estimate of curvature.
        """
        surface = self.mesh.geometry(vertices)
        normals, rims = surface.normals, find_rims(surface, self.silhouettes, outlines)
        if contour_error is not None:
            rims = by_pixel_sides(rims, self.silhouettes, contour_error)
        curvature = _mean_curvature(vertices, normals, self.edges, self.mesh.mean)
        typical = np.zeros_like(curvature.value)
        if prior.typical_curvature:
            typical = _typical_curvature(curvature.value, vertices, normals, _NORMAL_DISTANCE * self.size)
        excess = curvature.value - typical
        # While the prior is strong, large curvature may belong to the roofs of the visual hull instead of edges.
        stiffness = self._stiffness(excess, prior.edge * max(1.0, strength))
        pressure = -self.degree * curvature.around / np.sqrt(curvature.around.mean()) * typical
        per_observation = strength * len(rims.fraction)
        bending = per_observation * prior.bending * self.size**2 * (_REDUCED_BENDING if steady else 1)
        terms = [
            (1.0, _outline_term(rims, normals)),
            (per_observation * prior.area, self._area_term(vertices, normals, stiffness, pressure)),
            (bending, _bending_term(curvature, stiffness, excess)),
        ]
        if steady:
            changes = steady * len(rims.fraction) * self.size**2
            terms.append((changes, self._change_term(vertices, normals, curvature)))
        system = sum(weight * term.system for weight, term in terms)
        right = np.sum([weight * term.right for weight, term in terms], axis=0)
        longest = 2 * self.mesh.edge_length(vertices)
        vertices = vertices + solve_symmetric(system, right).clip(-longest, longest)[:, None] * normals
        return self.mesh.spread(vertices) if spread else vertices

    def _stiffness(self, excess: Float[np.ndarray, " vertices"], edge: float) -> Float[np.ndarray, " vertices"]:
        """Compute the factor of the prior at each vertex, which is small where curvature above `edge` is an edge."""
        bent = np.abs(excess)
        return 1 / np.hypot(1, 0.5 * (bent + self.mesh.mean @ bent) / edge)

    def _area_term(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        normals: Float[np.ndarray, "vertices 3"],
        stiffness: Float[np.ndarray, " vertices"],
        pressure: Float[np.ndarray, " vertices"],
    ) -> _Term:
        """Sum of squared edge lengths, balanced by a pressure along the normals."""
        tension = self.across.T @ sparse.diags(stiffness[self.edges].prod(1)) @ self.across
        system = sum(n @ tension @ n for n in map(sparse.diags, normals.T))
        stretched = sum(normals[:, axis] * (tension @ vertices[:, axis]) for axis in range(3))
        return _Term(system, pressure - stretched)

    def _change_term(
        self, vertices: Float[np.ndarray, "vertices 3"], normals: Float[np.ndarray, "vertices 3"], curvature: _Curvature
    ) -> _Term:
        """Sum of squared changes of curvature along edges and flat sides."""
        alike = sparse.diags(_along_edges(vertices, normals, self.edges, self.mesh.mean))
        changes = curvature.change.T @ self.across.T @ alike @ self.across
        return _Term(changes @ curvature.change, -changes @ curvature.value)


class _Term(NamedTuple):
    """Half the second derivative of a term with respect to the displacements, and minus half its gradient."""

    system: sparse.spmatrix
    right: Float[np.ndarray, " vertices"]


class _Curvature(NamedTuple):
    """Half the mean curvature at vertices times the edge length, negative on a ball."""

    change: sparse.csr_matrix  # derivative with respect to displacements along the normals
    value: Float[np.ndarray, " vertices"]
    around: Float[np.ndarray, " vertices"]  # mean squared length of the edges at each vertex


def _outline_term(rims: Rims, normals: Float[np.ndarray, "vertices 3"]) -> _Term:
    """Sum of squared distances of contour points to the outlines of the masks."""
    num_rims = len(rims.fraction)
    row, column = np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])
    along = (normals[column] * np.tile(rims.normal, (2, 1))).sum(1)
    weights = along * np.concatenate([1 - rims.fraction, rims.fraction])
    observed = sparse.csr_matrix((weights, (row, column)), (num_rims, len(normals)))
    return _Term(observed.T @ sparse.diags(rims.weight) @ observed, observed.T @ (rims.weight * rims.misfit))


def _bending_term(
    curvature: _Curvature, stiffness: Float[np.ndarray, " vertices"], excess: Float[np.ndarray, " vertices"]
) -> _Term:
    """Sum of squared curvatures beyond the typical curvature."""
    weighted = curvature.change.T @ sparse.diags(stiffness)
    return _Term(weighted @ curvature.change, -weighted @ excess)


def _split_views(outlines: Outlines) -> tuple[Outlines, Outlines]:
    """Split the views into training and validation views."""
    chosen = range(VALIDATION_EVERY - 1, len(outlines), VALIDATION_EVERY) or [len(outlines) - 1]
    validation = {view: outlines[view] for view in chosen}
    return {view: outline for view, outline in outlines.items() if view not in validation}, validation


def _mean_curvature(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    edges: Int[np.ndarray, "edges 2"],
    mean: sparse.csr_matrix,
) -> _Curvature:
    """Compute the curvature at vertices, see `_Curvature`.

    The mean of the neighbours of a vertex is displaced by r^2 H / 2 along the normal, with the mean curvature H and the
    mean squared edge length r^2.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    square = ((vertices[both[:, 0]] - vertices[both[:, 1]]) ** 2).sum(1)
    around = np.bincount(both[:, 0], square) / np.bincount(both[:, 0])
    typical = around.mean()
    # Marching cubes produces some very small triangles, whose curvature is noise.
    scale = sparse.diags(np.sqrt(typical) / around.clip(0.05 * typical))
    umbrella = mean - sparse.identity(len(vertices))
    change = scale @ sum(n @ umbrella @ n for n in map(sparse.diags, normals.T))
    return _Curvature(change.tocsr(), scale @ (normals * (umbrella @ vertices)).sum(1), around)


def _along_edges(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    edges: Int[np.ndarray, "edges 2"],
    mean: sparse.csr_matrix,
) -> Float[np.ndarray, " edges"]:
    """Weight edges by their alignment with the direction of smallest curvature: 1 along, 0 across, 1 if undefined."""
    along, turn = (values[edges[:, 1]] - values[edges[:, 0]] for values in (vertices, normals))
    square = (along**2).sum(1)
    turning = turn[:, :, None] * turn[:, None, :] * (square.mean() / square)[:, None, None]
    sums = [np.bincount(edges.ravel(), np.repeat(each, 2), len(vertices)) for each in turning.reshape(-1, 9).T]
    around = np.stack(sums, -1) / np.bincount(edges.ravel(), minlength=len(vertices))[:, None]
    for _ in range(_BLURS):
        around = 0.5 * (around + mean @ around)
    size, direction = np.linalg.eigh(around.reshape(-1, 3, 3))
    # 0 for equal curvature in both directions, 1 for curvature in a single direction.
    single = (size[:, 2] - size[:, 1]) / (size[:, 2] + size[:, 1] + _MIN_TURN**2)
    along /= np.sqrt(square)[:, None]
    ends = [single[end] * np.abs((along * direction[end, :, 2]).sum(1)) for end in edges.T]
    return ((1 - ends[0]) * (1 - ends[1])) ** _SHARPNESS


def _typical_curvature(
    curved: Float[np.ndarray, " vertices"],
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    normal_distance: float,
) -> Float[np.ndarray, " vertices"]:
    """Compute the curvature that most neighbours of each vertex exceed, with the sign of their median.

    Neighbours are nearest in position and normal, with `normal_distance` per radian, so that the opposite side of a
    thin wall is far away.
    """
    points = np.concatenate([vertices, normal_distance * normals], 1)
    chosen = np.linspace(0, len(points) - 1, min(len(points), _NUM_SPREAD)).astype(np.int64)
    _, index = cKDTree(points[chosen]).query(points, k=min(_NUM_NEIGHBOURS, len(chosen)))
    near = curved[chosen][index]
    sign = np.sign(np.median(near, axis=1))
    return sign * np.quantile((near * sign[:, None]).clip(min=0), 1 - _MIN_EXCEEDING, axis=1)
