"""Fit of a smooth surface to silhouettes, starting from the visual hull."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from nerfro.core.progress import progress_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.creases import CreaseSettings, Sides, has_creases, sharpened
from nerfro.silhouettes.moving_mesh import MeshGeometry, MovingMesh, solve_symmetric
from nerfro.silhouettes.rims import (
    Outlines,
    PixelSideSettings,
    Rims,
    RimSettings,
    by_pixel_sides,
    find_rims,
    outlines_of,
)
from nerfro.silhouettes.silhouettes import VALIDATION_EVERY, is_antialiased
from nerfro.silhouettes.visual_hull import Silhouettes


@dataclass(frozen=True)
class Prior:
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


@dataclass(frozen=True)
class FitSettings(AlgorithmSettings):
    """Settings of the smooth fit to silhouettes (`fit_surface`).

    The priors were chosen on the scenes `torus` and `ship` with antialiased masks. Exact binary masks have a mean
    contour error of 0.10 to 0.16 pixels, and masks displaced in waves by half a pixel 0.28.

    Attributes:
        round_prior, flat_prior: priors of the first and of the second surface.
        steps: number of steps with decreasing strength of the prior.
        last_steps: number of last steps with the selected strength.
        probit_steps: number of last steps with the probit model of pixels, for accurate binary masks.
        probit_strength: factor of the strength for these steps.
        max_probit_error: mean contour error in pixels above which binary masks count as inaccurate.
        reduced_bending: factor of bending in steps that also penalize changes of curvature: strong bending would round
            the edges.
        blurs: number of blurs of the direction of largest curvature.
        min_turn: turn between neighbours in radians below which this direction is undefined.
        sharpness: exponent by which changes of curvature across an edge are discounted.
        tolerance: the strongest prior is selected whose validation error is within this factor of the smallest: noise
            in the masks tilts the surface before it increases the contour error.
        normal_distance: distance that corresponds to normals one radian apart, as a fraction of the object's size.
        min_exceeding: fraction of the neighbours of a vertex that exceed the typical curvature: 0 on flat sides, the
            ball's curvature on a ball.
        num_neighbours: number of neighbours of a vertex for the typical curvature.
        num_spread: number of vertices, spread over the surface, among which neighbours are searched for.
        creases, rims, pixel_sides: settings of sharp edges, of contour points, and of the probit model.
    """

    round_prior: Prior = Prior(
        area=3e-6, bending=1e-5, first=100, last=0.01, typical_curvature=True, edge=math.inf, steady=0
    )
    flat_prior: Prior = Prior(
        area=3e-6, bending=5e-9, first=100, last=0.1, typical_curvature=False, edge=0.02, steady=4
    )
    steps: int = 22
    last_steps: int = 6
    probit_steps: int = 14
    probit_strength: float = 0.3
    max_probit_error: float = 0.2
    reduced_bending: float = 0.1
    blurs: int = 4
    min_turn: float = math.radians(0.5)
    sharpness: float = 4
    tolerance: float = 1.1
    normal_distance: float = 0.08
    min_exceeding: float = 0.7
    num_neighbours: int = 31
    num_spread: int = 1000
    creases: CreaseSettings = field(default=CreaseSettings(), repr=False)
    rims: RimSettings = field(default=RimSettings(), repr=False)
    pixel_sides: PixelSideSettings = field(default=PixelSideSettings(), repr=False)


def fit_surface(
    mesh: TriangleMesh, silhouettes: Silhouettes, smoothing: float = 1.0, settings: FitSettings = FitSettings()
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
    vertices of large curvature. Validation views select the strength of each prior. The last steps of the second
    surface replace most of the bending term by

        g sum_edges w_ij (h (H_i - H_j))^2

    where w decreases from 1 along the direction of smallest curvature to 0 across it, so that an edge keeps one profile
    along its length and flat sides stay flat. The weight g is proportional to the squared mean misfit, an estimate of
    the noise of the masks. The validation error is not such an estimate, because with few views it also contains errors
    in regions that no training view determines.

    For accurate binary masks, the last steps use the probit model of `by_pixel_sides`. If the second surface has
    creases, two variants with sharp edges are made (see `sharpened`), whose last steps use distances. Each surface
    makes its last steps with the training views, and the validation views select one. The selected surface then makes
    its last steps with all views.

    Args:
        mesh: closed mesh with triangles of similar size, as marching cubes produces.
        silhouettes: silhouettes of the object.
        smoothing: factor of the selected strength; larger values suit masks drawn by hand.
        settings: priors, numbers of steps and limits.

    Raises:
        NerfroError: no view sees the surface.
    """
    settings.use()
    fit, creases = _Fit(mesh, silhouettes, settings), settings.creases
    with progress_bar("fitting", 2 * settings.steps + 3 * settings.last_steps) as bar:
        starts = [fit.search(prior, bar.update) for prior in (settings.round_prior, settings.flat_prior)]
        probit = fit.has_accurate_binary_masks(starts)
        num_last_steps = settings.probit_steps if probit else settings.last_steps
        bar.total = 2 * settings.steps + 3 * num_last_steps
        candidates = [fit.tried(start, probit, bar.update) for start in starts]
        if has_creases(fit.mesh.geometry(starts[-1].vertices)):
            bar.total += 2 * creases.steps
            sharp = (starts[-1]._replace(sides=sides) for sides in (creases.facets, creases.curved))
            facets, curved = (fit.tried(candidate, probit, bar.update) for candidate in sharp)
            candidates.append(facets if facets.error <= settings.tolerance * curved.error else curved)
        best = min(candidates, key=lambda candidate: candidate.error)
        if best.sides is not None:
            bar.total += creases.steps - num_last_steps
        return TriangleMesh(fit.finished(best, fit.outlines, probit, bar.update, smoothing), mesh.faces)


class _Candidate(NamedTuple):
    """A surface from which the last steps start."""

    prior: Prior
    strength: float
    vertices: Float[np.ndarray, "vertices 3"]
    error: float  # mean misfit to the validation views in world units, see `_Fit.search` and `tried`
    sides: Sides | None = None  # prior of the sides, for a surface with sharp edges


class _Fit:
    """Mesh connectivity and views of a fit."""

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes, settings: FitSettings) -> None:
        self.settings = settings
        self.start, self.mesh, self.silhouettes = mesh.vertices, MovingMesh(mesh.faces), silhouettes
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        edges = self.mesh.edges
        # Sparse matrix that maps values at vertices to differences along edges.
        signs, number = np.repeat([1.0, -1.0], len(edges)), np.tile(np.arange(len(edges)), 2)
        self.across = scipy.sparse.csr_matrix((signs, (number, edges.T.ravel())), (len(edges), len(mesh.vertices)))
        self.outlines = outlines_of(silhouettes)
        self.training, self.validation = _split_views(self.outlines)

    def search(self, prior: Prior, step: Callable[[], object]) -> _Candidate:
        """Fit with decreasing strength of the prior, and select the strength by validation views."""
        vertices, candidates = self.start, []
        for strength in np.geomspace(prior.first, prior.last, self.settings.steps).tolist():
            vertices = self.moved(vertices, self.training, prior, strength)
            candidates.append(_Candidate(prior, strength, vertices, self.misfit(vertices, self.validation)))
            step()
        limit = self.settings.tolerance * min(candidate.error for candidate in candidates)
        return next(candidate for candidate in candidates if candidate.error <= limit)

    def tried(self, candidate: _Candidate, probit: bool, step: Callable[[], object]) -> _Candidate:
        """Compute the validation error after trial steps, which are the last steps with the training views.

        The last steps of a surface with sharp edges start from the result.
        """
        vertices = self.finished(candidate, self.training, probit, step)
        start = candidate.vertices if candidate.sides is None else vertices
        return candidate._replace(vertices=start, error=self.validation_error(vertices, probit))

    def finished(
        self,
        candidate: _Candidate,
        outlines: Outlines,
        probit: bool,
        step: Callable[[], object],
        smoothing: float = 1.0,
    ) -> Float[np.ndarray, "vertices 3"]:
        """Make the last steps of a candidate and return its vertices.

        Args:
            candidate: the surface before these steps.
            outlines: outlines of the views that are used.
            probit: whether to use the probit model of binary masks instead of distances.
            step: called after each step.
            smoothing: factor of the strength.
        """
        vertices, prior, sides = candidate.vertices, candidate.prior, candidate.sides
        if sides is not None:
            sides = replace(sides, flat=smoothing * sides.flat)
            rims_of, creases = lambda moved: self.rims(moved, outlines), self.settings.creases
            return sharpened(vertices, self.mesh, rims_of, sides, step, creases)
        factor, num_steps, contour_error = smoothing, self.settings.last_steps, None
        rims = self.rims(vertices, outlines)
        if probit:
            factor, num_steps = self.settings.probit_strength * smoothing, self.settings.probit_steps
            contour_error = _contour_error(rims)
        steady = factor * prior.steady * (float(np.abs(rims.misfit).mean()) / self.size) ** 2
        strength = factor * candidate.strength
        for left in reversed(range(num_steps)):
            vertices = self.moved(vertices, outlines, prior, strength, steady, contour_error, spread=left > 0)
            step()
        return vertices

    def rims(self, vertices: Float[np.ndarray, "vertices 3"], outlines: Outlines) -> Rims:
        """Find the contour points of a surface with the given vertices."""
        return find_rims(self.mesh.geometry(vertices), self.silhouettes, outlines, self.settings.rims)

    def misfit(self, vertices: Float[np.ndarray, "vertices 3"], outlines: Outlines) -> float:
        """Compute the mean distance of the contour points to the outlines of the masks, in world units."""
        return float(np.abs(self.rims(vertices, outlines).misfit).mean())

    def validation_error(self, vertices: Float[np.ndarray, "vertices 3"], probit: bool) -> float:
        """Compute the mean misfit to the validation views, in world units.

        For accurate binary masks, misfits are those of `by_pixel_sides`, because the noise of interpolated outlines
        would hide differences between surfaces. Surfaces that are too inaccurate for the probit model keep their
        misfits to the outlines, which are larger.
        """
        rims, weights = self.rims(vertices, self.validation), None
        contour_error = _contour_error(rims)
        if probit and contour_error < self.settings.max_probit_error:
            rims = by_pixel_sides(rims, self.silhouettes, contour_error, self.settings.pixel_sides)
            weights = rims.weight
            if not weights.any():
                return np.inf
        return float(np.average(np.abs(rims.misfit), weights=weights))

    def has_accurate_binary_masks(self, candidates: list[_Candidate]) -> bool:
        """Test whether the masks are binary, and accurate for at least one candidate."""
        if is_antialiased(self.silhouettes.masks.numpy(), self.silhouettes.distances.numpy()):
            return False
        errors = [_contour_error(self.rims(candidate.vertices, self.training)) for candidate in candidates]
        return min(errors) < self.settings.max_probit_error

    def moved(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        outlines: Outlines,
        prior: Prior,
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
        surface, settings = self.mesh.geometry(vertices), self.settings
        normals, rims = surface.normals, find_rims(surface, self.silhouettes, outlines, settings.rims)
        if contour_error is not None:
            rims = by_pixel_sides(rims, self.silhouettes, contour_error, settings.pixel_sides)
        curvature = _mean_curvature(surface, self.mesh)
        typical = np.zeros_like(curvature.value)
        if prior.typical_curvature:
            typical = _typical_curvature(curvature.value, surface, settings.normal_distance * self.size, settings)
        excess = curvature.value - typical
        # While the prior is strong, large curvature may belong to the roofs of the visual hull instead of edges.
        stiffness = self._stiffness(excess, prior.edge * max(1.0, strength))
        pressure = -self.mesh.degree * curvature.around / np.sqrt(curvature.around.mean()) * typical
        per_observation = strength * len(rims.fraction)
        bending = per_observation * prior.bending * self.size**2 * (settings.reduced_bending if steady else 1)
        terms = [
            (1.0, _outline_term(rims, normals)),
            (per_observation * prior.area, self._area_term(surface, stiffness, pressure)),
            (bending, _bending_term(curvature, stiffness, excess)),
        ]
        if steady:
            changes = steady * len(rims.fraction) * self.size**2
            terms.append((changes, self._change_term(surface, curvature)))
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
        self, surface: MeshGeometry, stiffness: Float[np.ndarray, " vertices"], pressure: Float[np.ndarray, " vertices"]
    ) -> _Term:
        """Sum of squared edge lengths, balanced by a pressure along the normals."""
        tension = self.across.T @ scipy.sparse.diags(stiffness[surface.edges].prod(1)) @ self.across
        system = sum(n @ tension @ n for n in map(scipy.sparse.diags, surface.normals.T))
        stretched = sum(n * (tension @ x) for n, x in zip(surface.normals.T, surface.vertices.T, strict=True))
        return _Term(system, pressure - stretched)

    def _change_term(self, surface: MeshGeometry, curvature: _Curvature) -> _Term:
        """Sum of squared changes of curvature along edges and flat sides."""
        alike = scipy.sparse.diags(_along_edges(surface, self.mesh, self.settings))
        changes = curvature.change.T @ self.across.T @ alike @ self.across
        return _Term(changes @ curvature.change, -changes @ curvature.value)


def _contour_error(rims: Rims) -> float:
    """Compute the mean distance of the contour points to the outlines of the masks, in pixels."""
    return float(np.abs(rims.misfit / rims.width).mean())


class _Term(NamedTuple):
    """Half the second derivative of a term with respect to the displacements, and minus half its gradient."""

    system: scipy.sparse.spmatrix
    right: Float[np.ndarray, " vertices"]


class _Curvature(NamedTuple):
    """Half the mean curvature at vertices times the edge length, negative on a ball."""

    change: scipy.sparse.csr_matrix  # derivative with respect to displacements along the normals
    value: Float[np.ndarray, " vertices"]
    around: Float[np.ndarray, " vertices"]  # mean squared length of the edges at each vertex


def _outline_term(rims: Rims, normals: Float[np.ndarray, "vertices 3"]) -> _Term:
    """Sum of squared distances of contour points to the outlines of the masks."""
    num_rims = len(rims.fraction)
    row, column = np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])
    along = (normals[column] * np.tile(rims.normal, (2, 1))).sum(1)
    weights = along * np.concatenate([1 - rims.fraction, rims.fraction])
    observed = scipy.sparse.csr_matrix((weights, (row, column)), (num_rims, len(normals)))
    return _Term(observed.T @ scipy.sparse.diags(rims.weight) @ observed, observed.T @ (rims.weight * rims.misfit))


def _bending_term(
    curvature: _Curvature, stiffness: Float[np.ndarray, " vertices"], excess: Float[np.ndarray, " vertices"]
) -> _Term:
    """Sum of squared curvatures beyond the typical curvature."""
    weighted = curvature.change.T @ scipy.sparse.diags(stiffness)
    return _Term(weighted @ curvature.change, -weighted @ excess)


def _split_views(outlines: Outlines) -> tuple[Outlines, Outlines]:
    """Split the views into training and validation views."""
    views = range(VALIDATION_EVERY - 1, len(outlines), VALIDATION_EVERY) or [len(outlines) - 1]
    validation = {view: outlines[view] for view in views}
    return {view: outline for view, outline in outlines.items() if view not in validation}, validation


def _mean_curvature(surface: MeshGeometry, mesh: MovingMesh) -> _Curvature:
    """Compute the curvature at vertices, see `_Curvature`.

    The mean of the neighbours of a vertex is displaced by r^2 H / 2 along the normal, with the mean curvature H and the
    mean squared edge length r^2.
    """
    vertices, normals = surface.vertices, surface.normals
    both = np.concatenate([surface.edges, surface.edges[:, ::-1]])
    square = ((vertices[both[:, 0]] - vertices[both[:, 1]]) ** 2).sum(1)
    around = np.bincount(both[:, 0], square) / mesh.degree
    typical = around.mean()
    # Marching cubes produces some very small triangles, whose curvature is noise.
    scale = scipy.sparse.diags(np.sqrt(typical) / around.clip(0.05 * typical))
    umbrella = mesh.mean - scipy.sparse.identity(len(vertices))
    change = scale @ sum(n @ umbrella @ n for n in map(scipy.sparse.diags, normals.T))
    return _Curvature(change.tocsr(), scale @ (normals * (umbrella @ vertices)).sum(1), around)


def _along_edges(surface: MeshGeometry, mesh: MovingMesh, settings: FitSettings) -> Float[np.ndarray, " edges"]:
    """Weight edges by their alignment with the direction of smallest curvature: 1 along, 0 across, 1 if undefined."""
    edges, num_vertices = surface.edges, len(surface.vertices)
    along, turn = (values[edges[:, 1]] - values[edges[:, 0]] for values in (surface.vertices, surface.normals))
    square = (along**2).sum(1)
    turning = turn[:, :, None] * turn[:, None, :] * (square.mean() / square)[:, None, None]
    sums = [np.bincount(edges.ravel(), np.repeat(products, 2), num_vertices) for products in turning.reshape(-1, 9).T]
    around = np.stack(sums, -1) / mesh.degree[:, None]
    for _ in range(settings.blurs):
        around = 0.5 * (around + mesh.mean @ around)
    size, direction = np.linalg.eigh(around.reshape(-1, 3, 3))
    # 0 for equal curvature in both directions, 1 for curvature in a single direction.
    single = (size[:, 2] - size[:, 1]) / (size[:, 2] + size[:, 1] + settings.min_turn**2)
    along /= np.sqrt(square)[:, None]
    ends = [single[end] * np.abs((along * direction[end, :, 2]).sum(1)) for end in edges.T]
    return ((1 - ends[0]) * (1 - ends[1])) ** settings.sharpness


def _typical_curvature(
    curved: Float[np.ndarray, " vertices"], surface: MeshGeometry, normal_distance: float, settings: FitSettings
) -> Float[np.ndarray, " vertices"]:
    """Compute the curvature that most neighbours of each vertex exceed, with the sign of their median.

    Neighbours are nearest in position and normal, with `normal_distance` per radian, so that the opposite side of a
    thin wall is far away.
    """
    points = np.concatenate([surface.vertices, normal_distance * surface.normals], 1)
    spread = np.linspace(0, len(points) - 1, min(len(points), settings.num_spread)).astype(np.int64)
    _, index = scipy.spatial.KDTree(points[spread]).query(points, k=min(settings.num_neighbours, len(spread)))
    near = curved[spread][index]
    sign = np.sign(np.median(near, axis=1))
    return sign * np.quantile((near * sign[:, None]).clip(min=0), 1 - settings.min_exceeding, axis=1)
