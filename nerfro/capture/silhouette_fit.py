"""From the visual hull to a smooth surface whose silhouettes are still the masks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from nerfro.capture.creases import CURVED, FACETS, STEPS, Sides, has_creases, sharpened
from nerfro.capture.moving_mesh import MovingMesh, solve_symmetric
from nerfro.capture.pixel_sides import by_pixel_sides
from nerfro.capture.rims import Outlines, Rims, find_rims, outlines_of
from nerfro.capture.silhouettes import holds_shares
from nerfro.capture.surroundings import HELD_BACK
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.mesh import TriangleMesh


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
    steady: float  # in the last steps: weight of changes of curvature, for each square of what views are off


# Chosen on the scenes `torus` and `ship`, with masks of shares.
_ROUND = _Prior(area=3e-6, bending=1e-5, first=100, last=0.01, usual=True, edge=np.inf, steady=0)
_FLAT = _Prior(area=3e-6, bending=5e-9, first=100, last=0.1, usual=False, edge=0.02, steady=4)
# Steps of falling strength, and steps after them, with all views, of the strength that was best.
_STEPS, _LAST_STEPS = 22, 6
# Binary masks: last steps, which look at the sides of pixels, and the share of the strength that is right for these.
# Outlines that are farther off than this, mean, pixels, are wrong themselves: exact ones are off by 0.10 to 0.16, and
# those that were moved by half a pixel, in waves, by 0.28.
_STEPS_BY_SIDES, _LEFT_BY_SIDES, _EXACT = 14, 0.3, 0.2
# Where curvature shall be steady, bending is hardly needed any more, and would draw edges in.
_BENDING_LEFT = 0.1
# Around a vertex, so many times half of what is known of its neighbours' normals is taken, to see in which direction
# they turn most. Turns by less than this from neighbour to neighbour have no direction, radians. The sharper, the less
# is asked of curvature across an edge.
_BLURS, _NO_TURN, _SHARPNESS = 4, np.radians(0.5), 4
# The strongest is taken whose outlines are at most so many times as far from the masks' as the nearest: noise of masks
# tilts a surface before it moves its outlines.
_AS_GOOD = 1.1
# A normal that is turned by a radian counts as far away as this share of the object's size. Curvature is usual around a
# vertex if this share of the vertices there have at least as much: 0 on flat sides and low roofs, the ball's on a ball.
_TURN, _LEAST_SHARE = 0.08, 0.7
# Around a vertex are so many of these, spread over the whole surface.
_NUM_AROUND, _NUM_SPREAD = 31, 1000


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

    Where the second is better, the last steps replace most of its bending, which rounds edges, by

        g sum_edges w_ij (h (H_i - H_j))^2

    with w from 1 along the direction in which the surface bends least to 0 across it: an edge has one profile along its
    length, and flat sides stay flat. The weight g grows with the square of what views that were held back are off.

    The last steps look at exact binary masks once more, for what they say for certain, see `by_pixel_sides`.

    Where the second has creases, sharp ones are made of it in two ways, see `sharpened`, and the views that are held
    back decide between all.

    The mesh is closed and has triangles of about one size, such as marching cubes give. `smoothing` multiplies the
    strength that was found; more of it suits masks that were drawn by hand. `progress` is told the share done.
    """
    count, total = itertools.count(1), 2 * _STEPS + _LAST_STEPS

    def step() -> None:
        progress(next(count) / total)

    fit, outlines = _Fit(mesh, silhouettes), outlines_of(silhouettes)
    found = [fit.search(prior, outlines, step) for prior in (_ROUND, _FLAT)]
    if has_creases(fit.mesh.surface(found[1].vertices)):
        total = 2 * _STEPS + 3 * STEPS
        facets, curved = (fit.with_creases(found[1], sides, outlines, step) for sides in (FACETS, CURVED))
        found.append(facets if facets.misfit <= _AS_GOOD * curved.misfit else curved)
    best = min(found, key=lambda each: each.misfit)
    vertices = best.vertices
    if best.sides is not None:
        sides = best.sides._replace(flat=smoothing * best.sides.flat)
        return TriangleMesh(fit.sharpened(vertices, sides, outlines, step), mesh.faces)
    strength, last_steps = smoothing * best.strength, _LAST_STEPS
    off = fit.off_by_pixels_alone(vertices, outlines)
    if off is not None:
        strength, last_steps = _LEFT_BY_SIDES * strength, _STEPS_BY_SIDES
        total += _STEPS_BY_SIDES - _LAST_STEPS
    steady = strength / best.strength * best.prior.steady * (best.misfit / fit.size) ** 2
    for left in reversed(range(last_steps)):
        vertices = fit.moved(vertices, outlines, best.prior, strength, steady, off, spread=left > 0)
        step()
    return TriangleMesh(vertices, mesh.faces)


class _Found(NamedTuple):
    """The surface of one prior with which views that were held back agree best, and its mean misfit there."""

    prior: _Prior
    strength: float
    vertices: Float[np.ndarray, "V 3"]
    misfit: float
    sides: Sides | None = None  # between sharp edges


class _Fit:
    """What all steps of a fit share: the triangles and the views."""

    def __init__(self, mesh: TriangleMesh, silhouettes: Silhouettes) -> None:
        self.start, self.mesh, self.silhouettes = mesh.vertices, MovingMesh(mesh.faces), silhouettes
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self.edges = edges = self.mesh.edges
        self.degree = np.bincount(edges.ravel())
        # Takes values at vertices to their differences along edges.
        signs, number = np.repeat([1.0, -1.0], len(edges)), np.tile(np.arange(len(edges)), 2)
        self.across = sparse.csr_matrix((signs, (number, edges.T.ravel())), (len(edges), len(mesh.vertices)))

    def search(self, prior: _Prior, outlines: Outlines, step: Callable[[], None]) -> _Found:
        """Fit with a prior that becomes weaker and weaker; views that are held back tell the best strength."""
        teachers, judges = _divided(outlines)
        vertices, found = self.start, []
        for strength in np.geomspace(prior.first, prior.last, _STEPS).tolist():
            vertices = self.moved(vertices, teachers, prior, strength)
            found.append(_Found(prior, strength, vertices, self.misfit(vertices, judges)))
            step()
        enough = _AS_GOOD * min(each.misfit for each in found)
        return next(each for each in found if each.misfit <= enough)

    def with_creases(self, blunt: _Found, sides: Sides, outlines: Outlines, step: Callable[[], None]) -> _Found:
        """A surface whose edges are sharp, of one whose edges are not."""
        teachers, judges = _divided(outlines)
        vertices = self.sharpened(blunt.vertices, sides, teachers, step)
        return blunt._replace(vertices=vertices, misfit=self.misfit(vertices, judges), sides=sides)

    def sharpened(
        self, vertices: Float[np.ndarray, "V 3"], sides: Sides, outlines: Outlines, step: Callable[[], None]
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices moved until edges are sharp."""
        return sharpened(vertices, self.mesh, lambda moved: self.rims(moved, outlines), sides, step)

    def rims(self, vertices: Float[np.ndarray, "V 3"], outlines: Outlines) -> Rims:
        """Where views see the outlines of a surface."""
        return find_rims(self.mesh.surface(vertices), self.silhouettes, outlines)

    def misfit(self, vertices: Float[np.ndarray, "V 3"], outlines: Outlines) -> float:
        """How far its outlines are from those of masks, mean."""
        return float(np.abs(self.rims(vertices, outlines).misfit).mean())

    def off_by_pixels_alone(self, vertices: Float[np.ndarray, "V 3"], outlines: Outlines) -> float | None:
        """What outlines of binary masks are off by, mean, pixels; none where masks hold shares, or are not exact."""
        if holds_shares(self.silhouettes.masks.numpy(), self.silhouettes.distances.numpy()):
            return None
        rims = self.rims(vertices, outlines)
        off = float(np.abs(rims.misfit / rims.width).mean())
        return off if off < _EXACT else None

    def moved(
        self,
        vertices: Float[np.ndarray, "V 3"],
        outlines: Outlines,
        prior: _Prior,
        strength: float,
        steady: float = 0.0,
        off: float | None = None,
        spread: bool = True,
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices after a step.

        Args:
            vertices: before.
            outlines: of the views that are looked at.
            prior: what is likely where these do not tell.
            strength: of its area and bending.
            steady: weight of changes of curvature, for each observation.
            off: for binary masks, what their outlines are off by, pixels: the sides of pixels are looked at instead.
            spread: also move along the surface, so that triangles become alike. Small and large ones side by side, as
                marching cubes leave them, have a mean of neighbours that says more about them than about curvature.
        """
        surface = self.mesh.surface(vertices)
        normals, rims = surface.normals, find_rims(surface, self.silhouettes, outlines)
        if off is not None:
            rims = by_pixel_sides(rims, rims.points(vertices), self.silhouettes, off)
        num_rims = len(rims.share)
        area = strength * num_rims * prior.area
        bending = strength * num_rims * prior.bending * self.size**2 * (_BENDING_LEFT if steady else 1)
        row, column = np.tile(np.arange(num_rims), 2), np.concatenate([rims.first, rims.second])
        along = (normals[column] * np.tile(rims.normal, (2, 1))).sum(1)
        shares = along * np.concatenate([1 - rims.share, rims.share])
        observed = sparse.csr_matrix((shares, (row, column)), (num_rims, len(vertices)))
        curvature, curved, around = _mean_curvature(vertices, normals, self.edges, self.mesh.mean)
        usual = _usual_curvature(curved, vertices, normals, _TURN * self.size) if prior.usual else 0 * curved
        bent = np.abs(curved - usual)
        # What is bent while the prior is still strong may be the roofs that it shall level.
        edge = prior.edge * max(1.0, strength)
        stiff = 1 / np.hypot(1, 0.5 * (bent + self.mesh.mean @ bent) / edge)
        stiffness, tension = sparse.diags(stiff), self.across.T @ sparse.diags(stiff[self.edges].prod(1)) @ self.across
        stretch = sum(n @ tension @ n for n in map(sparse.diags, normals.T))
        stretched = sum(normals[:, a] * (tension @ vertices[:, a]) for a in range(3))
        pressure = -self.degree * around / np.sqrt(around.mean()) * usual
        system = observed.T @ sparse.diags(rims.weight) @ observed + area * stretch
        system += bending * (curvature.T @ stiffness @ curvature)
        right = observed.T @ (rims.weight * rims.misfit) - area * (stretched - pressure)
        right -= bending * (curvature.T @ (stiffness @ (curved - usual)))
        if steady:
            alike = sparse.diags(_along_edges(vertices, normals, self.edges, self.mesh.mean))
            changes = steady * num_rims * self.size**2 * (curvature.T @ self.across.T @ alike @ self.across)
            system += changes @ curvature
            right -= changes @ curved
        longest = 2 * self.mesh.edge_length(vertices)
        vertices = vertices + solve_symmetric(system, right).clip(-longest, longest)[:, None] * normals
        return self.mesh.spread(vertices) if spread else vertices


def _divided(outlines: Outlines) -> tuple[Outlines, Outlines]:
    """Views to fit a surface to, and those that are held back."""
    judging = range(HELD_BACK - 1, len(outlines), HELD_BACK) or [len(outlines) - 1]
    judges = {view: outlines[view] for view in judging}
    return {view: outline for view, outline in outlines.items() if view not in judges}, judges


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


def _along_edges(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    mean: sparse.csr_matrix,
) -> Float[np.ndarray, "E"]:
    """How much each edge goes where the surface bends least: 0 across, 1 along, and 1 where it is flat or round."""
    along, turn = (values[edges[:, 1]] - values[edges[:, 0]] for values in (vertices, normals))
    square = (along**2).sum(1)
    turning = turn[:, :, None] * turn[:, None, :] * (square.mean() / square)[:, None, None]
    sums = [np.bincount(edges.ravel(), np.repeat(each, 2), len(vertices)) for each in turning.reshape(-1, 9).T]
    around = np.stack(sums, -1) / np.bincount(edges.ravel(), minlength=len(vertices))[:, None]
    for _ in range(_BLURS):
        around = 0.5 * (around + mean @ around)
    size, direction = np.linalg.eigh(around.reshape(-1, 3, 3))
    # 0 where a surface turns alike in two directions, 1 where in one alone.
    single = (size[:, 2] - size[:, 1]) / (size[:, 2] + size[:, 1] + _NO_TURN**2)
    along /= np.sqrt(square)[:, None]
    ends = [single[end] * np.abs((along * direction[end, :, 2]).sum(1)) for end in edges.T]
    return ((1 - ends[0]) * (1 - ends[1])) ** _SHARPNESS


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
