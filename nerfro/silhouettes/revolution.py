"""Fit of a body of revolution to the outlines of the masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from skimage.measure import find_contours
from torch import Tensor
from torch.func import jacfwd
from torch.nn import functional
from torch.nn.functional import normalize

from nerfro.core.progress import counting_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.robust import geman_mcclure, geman_mcclure_weight
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.surfaces import revolve
from nerfro.silhouettes.upright import body_axis
from nerfro.silhouettes.visual_hull import Silhouettes

Symmetry = Literal["axis", "auto"]


@dataclass(frozen=True)
class RevolutionSettings(AlgorithmSettings):
    """Settings of the fit of a body of revolution (`fit_revolution`).

    Attributes:
        knots: number of radii along the axis.
        outer_quantile: quantile of the distances of vertices from the axis that gives the initial radius at a height:
            vertices on end faces lie nearer to the axis than the outline, and corners of the hull farther away.
        inner_quantile: the same for a given axis, because the hull of few views is much wider than the object.
        end_knots: knots at each end whose initial radii are extrapolated, because the hull is inaccurate there.
        outline_points, side_points: samples per mask on the outline, and on each side of it.
        near, far: smallest distance of the samples on both sides, and largest distance outside, in pixels.
        iterations: number of Gauss-Newton steps.
        robust_scale: first and last scale of the Geman-McClure loss in pixels: distance at which the weight is 1/4.
        bending: weight of bending relative to pixels.
        end_bending: factor of bending at the ends, where the masks show only thin slices.
        corner: bending at which its weight is one quarter, as a fraction of the height: objects have few, sharp
            corners. At the lower end, `end_bending` divides this bending; at the upper end, the weight stays 1.
        max_step: longest step, as a fraction of the height.
        min_radius: smallest radius, as a fraction of the height.
        edge: radius of the rounded edges, in pixels.
        cut_knots, max_cut: distance of the tested cuts of an end, and largest cut, in knots, less than `knots` - 1. The
            neighbours of the best one are tested, too.
        cut_iterations: number of steps before and after each cut.
        cut_scale: scale of the Geman-McClure loss that compares cuts, in pixels. With a scale of one pixel, views that
            contradict a cut would be outliers.
        max_rise: no larger cuts are tested if one exceeds the smallest mean robust error by more than this.
        ray_samples, closer_samples: number of samples along a ray, and of samples in each of two refinements.
        border: width of the ignored image border, in pixels.
    """

    knots: int = 72
    outer_quantile: float = 0.8
    inner_quantile: float = 0.1
    end_knots: int = 4
    outline_points: int = 100
    side_points: int = 40
    near: float = 3.0
    far: float = 40.0
    iterations: int = 24
    robust_scale: tuple[float, float] = (8.0, 1.0)
    bending: float = 2.0
    end_bending: float = 10.0
    corner: float = 0.002
    max_step: float = 0.03
    min_radius: float = 1e-3
    edge: float = 0.5
    cut_knots: int = 3
    max_cut: int = 24
    cut_iterations: int = 4
    cut_scale: float = 4.0
    max_rise: float = 0.02
    ray_samples: int = 48
    closer_samples: int = 12
    border: int = 2


@dataclass(frozen=True)
class Profile:
    """A body of revolution with flat ends.

    Attributes:
        foot: intersection of the axis with the lower end, world units.
        axis: unit direction of the axis.
        height: distance between the ends.
        radii: radii at evenly spaced heights.
        edge: radius by which `distance` rounds the edges of the ends; both distances need a positive one.
    """

    foot: Float[Tensor, "3"]
    axis: Float[Tensor, "3"]
    height: Float[Tensor, ""]
    radii: Float[Tensor, " profile"]
    edge: float = 0.0

    def distance(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Compute an approximate signed distance, negative inside, to the body with rounded edges, which is smaller."""
        return self.edge * torch.logsumexp(self._signed(points) / self.edge, 0)

    def least_distance(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Compute the least distance to the body with sharp edges along each ray, where `distance` is least.

        There, the distances to side and ends, weighted by their shares in `distance`, do not change along the ray. If
        the ray passes an edge, this weighted mean is thus the distance where side and end are equally distant.
        """
        parts = self._signed(points)
        return (torch.softmax(parts.detach() / self.edge, 0) * parts).sum(0)

    def _signed(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, " 3 *points"]:
        """Compute signed distances to the side, the lower end and the upper end."""
        offset = points - self.foot
        along = offset @ self.axis
        radius = (offset - along[..., None] * self.axis).square().sum(-1).clamp(min=1e-20).sqrt()
        step = self.height / (len(self.radii) - 1)
        knot = (along / step).clamp(0, len(self.radii) - 1.001)
        low = knot.floor().long()
        first, second = self.radii[low], self.radii[low + 1]
        slope = ((second - first) / step).detach()
        side = (radius - torch.lerp(first, second, knot - low)) / (1 + slope.square()).sqrt()
        return torch.stack([side, -along, along - self.height])

    def mesh(self) -> TriangleMesh:
        """Convert the body to a closed mesh with counter-clockwise faces seen from outside."""
        axis, foot, radii = (values.double().numpy() for values in (self.axis, self.foot, self.radii))
        heights = np.linspace(0, float(self.height), len(radii))
        outline = np.column_stack([np.pad(radii, 1), np.pad(heights, 1, "edge")])
        return revolve(outline, foot, axis)


def fit_revolution(
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    axis: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None,
    settings: RevolutionSettings = RevolutionSettings(),
) -> TriangleMesh | None:
    """Fit a body of revolution to the outlines of the masks.

    The minimum distance to the body along a ray through the outline of a mask is zero. Rays on either side of the
    outline intersect the body or miss it. Axis, ends and radii minimize a robust sum of the squared distances in
    pixels, so that outlines of foreground objects have little influence.

    Args:
        mesh: initial surface.
        silhouettes: silhouettes of the object.
        axis: a point on the initial axis and the unit direction of the axis; None takes the axis around which the
            initial surface is most circular. With a given axis, the initial radii are those of the largest body of
            revolution inside the initial surface, because the visual hull of few views is much wider than the object.
        settings: samples, weights and limits.

    Returns:
        The fitted body; None if the initial surface has no axis.
    """
    settings.use()
    if axis is None:
        start = _initial_profile(mesh, settings)
    else:
        start = _profile_around(mesh, *axis, settings.inner_quantile, settings)[1]
    if start is None:
        return None
    first_scale, last_scale = settings.robust_scale
    # Two ends, and about five cuts of each.
    with counting_bar("finding the axis", settings.iterations + 2 * 5 * settings.cut_iterations) as advance:
        fit = _Fit(start, silhouettes, settings, advance)
        parameters = fit.start
        for iteration in range(settings.iterations):
            done = min(1.0, iteration / (settings.iterations - 6))
            parameters = fit.step(parameters, first_scale * (last_scale / first_scale) ** done)
        for end in ("upper", "lower"):  # a roof on the top would hide the best cut of the foot
            parameters = fit.with_cut_end(parameters, end)
    return fit.body(parameters).mesh()


class _Fit:
    """Gauss-Newton steps from an initial body, whose axis points towards the cameras.

    The parameters of a body are two translations and two rotations of the axis, both ends, and the radii; lengths are
    in units of the initial height.

    Args:
        start: initial body.
        silhouettes: silhouettes of the object.
        settings: samples, weights and limits.
        advance: called once for each step.

    Attributes:
        start: parameters of the initial body.
    """

    def __init__(
        self, start: Profile, silhouettes: Silhouettes, settings: RevolutionSettings, advance: Callable[[], None]
    ) -> None:
        self._settings, self._advance = settings, advance
        self._origins, self._directions, self._width, self._side = _rays(silhouettes, settings)
        self._middle, self._size = start.foot + 0.5 * start.height * start.axis, start.height
        apart = self._origins - self._middle
        is_upright = bool((apart @ start.axis).mean() >= 0)
        self._axis = start.axis if is_upright else -start.axis
        self._across = torch.linalg.svd(start.axis[None])[2][1:]
        self._pixels = float(self._size / (self._width * apart.norm(dim=-1)).median())  # in the height
        radii = start.radii if is_upright else start.radii.flip(0)
        self.start = torch.cat([torch.zeros(4), torch.tensor([-0.5, 0.5]), radii / self._size])
        knots, end = settings.knots, settings.end_knots
        self._bends = functional.pad(torch.eye(knots).diff(n=2, dim=0), (6, 0))
        self._bends[:end] *= settings.end_bending
        self._bends[-end:] *= settings.end_bending

    def body(self, parameters: Float[Tensor, " parameters"]) -> Profile:
        """Return the body with these parameters."""
        axis = normalize(self._axis + parameters[2:4] @ self._across, dim=0)
        foot = self._middle + self._size * (parameters[:2] @ self._across + parameters[4] * axis)
        radii = self._size * parameters[6:].clamp(min=self._settings.min_radius)
        edge = self._settings.edge * float(self._size) / self._pixels
        return Profile(foot, axis, self._size * (parameters[5] - parameters[4]), radii, edge)

    def step(self, parameters: Float[Tensor, " parameters"], scale: float) -> Float[Tensor, " parameters"]:
        """Make a step; `scale` is the scale of the Geman-McClure loss, in pixels."""
        settings, lengths = self._settings, self._nearest_lengths(parameters)
        misfit = self._misfits(parameters, lengths).double()
        slopes = jacfwd(self._misfits)(parameters, lengths).double()
        weight = geman_mcclure_weight(misfit[:, None], scale)
        smooth = 1 / (1 + (self._bends @ parameters / settings.corner).square()).square()  # corners have little weight
        smooth[-settings.end_knots :] = 1  # the upper end would flare
        stiffness = (settings.bending * self._pixels) ** 2 * len(misfit) / settings.knots
        stiff = stiffness * (self._bends.T @ (smooth[:, None] * self._bends)).double()
        system = slopes.T @ (weight[:, None] * slopes) + stiff
        right = slopes.T @ (weight * misfit) + stiff @ parameters.double()
        damping = 1e-3 * system.diagonal().mean() * torch.eye(len(parameters)).double()
        step = torch.linalg.solve(system + damping, right)
        self._advance()
        return parameters - (step * (settings.max_step / step.abs().max()).clamp(max=1)).float()

    def with_cut_end(
        self, parameters: Float[Tensor, " parameters"], end: Literal["lower", "upper"]
    ) -> Float[Tensor, " parameters"]:
        """Cut an end at the height with the smallest error, because steps do not find the shortest body.

        Few outlines contradict a cone below the foot or a low roof on the top, which bending connects with the side.

        Returns:
            Parameters of the body, after more steps.
        """
        settings, whole = self._settings, self._after_steps(parameters)
        bodies, errors = {0: whole}, {0: self._error(whole)}

        def attempt(cut: int) -> None:
            bodies[cut] = self._after_steps(_cut(whole, cut, end))
            errors[cut] = self._error(bodies[cut])

        for cut in range(settings.cut_knots, settings.max_cut + 1, settings.cut_knots):
            attempt(cut)
            if errors[cut] > min(errors.values()) + settings.max_rise:
                break
        best = min(errors, key=errors.__getitem__)
        for cut in {best - 1, best + 1}.intersection(range(1, settings.max_cut + 1)):
            attempt(cut)
        return bodies[min(errors, key=errors.__getitem__)]

    def _after_steps(self, parameters: Float[Tensor, " parameters"]) -> Float[Tensor, " parameters"]:
        """Make the steps before or after a cut."""
        for _ in range(self._settings.cut_iterations):
            parameters = self.step(parameters, self._settings.robust_scale[1])
        return parameters

    def _error(self, parameters: Float[Tensor, " parameters"]) -> float:
        """Compute the mean robust misfit."""
        misfits = self._misfits(parameters, self._nearest_lengths(parameters))
        return float(geman_mcclure(misfits[:, None], self._settings.cut_scale).mean())

    def _misfits(
        self, parameters: Float[Tensor, " parameters"], lengths: Float[Tensor, " points"]
    ) -> Float[Tensor, " points"]:
        """Compute distances of rays to the body in pixels; 0 for rays on their side of the outline."""
        points = self._origins + lengths[:, None] * self._directions
        apart = self.body(parameters).least_distance(points) / (self._width * lengths)
        return torch.where(self._side * apart > 0, 0.0, apart)

    @torch.no_grad()
    def _nearest_lengths(self, parameters: Float[Tensor, " parameters"]) -> Float[Tensor, " points"]:
        """Find the arc length along each ray at which the distance to the body is smallest."""
        body, settings, origins, directions = self.body(parameters), self._settings, self._origins, self._directions
        middle = body.foot + 0.5 * body.height * body.axis
        reach = torch.sqrt((0.5 * body.height) ** 2 + body.radii.max() ** 2)
        lengths = ((middle - origins) * directions).sum(-1)
        for count in (settings.ray_samples, settings.closer_samples, settings.closer_samples):
            candidates = lengths[:, None] + reach * torch.linspace(-1, 1, count)
            distances = body.distance(origins[:, None] + candidates[..., None] * directions[:, None])
            lengths = candidates.gather(1, distances.argmin(1, keepdim=True))[:, 0]
            reach = reach * 2 / (count - 1)
        return lengths


def _cut(
    parameters: Float[Tensor, " parameters"], count: int, end: Literal["lower", "upper"]
) -> Float[Tensor, " parameters"]:
    """Cut a body by `count` knots at an end; the number of radii stays."""
    radii, low, high = parameters[6:], parameters[4], parameters[5]
    kept = radii[count:] if end == "lower" else radii[: len(radii) - count]
    removed = count / (len(radii) - 1) * (high - low)
    ends = [low + removed, high] if end == "lower" else [low, high - removed]
    resampled = functional.interpolate(kept[None, None], len(radii), mode="linear", align_corners=True)[0, 0]
    return torch.cat([parameters[:4], torch.stack(ends), resampled])


def _initial_profile(mesh: TriangleMesh, settings: RevolutionSettings) -> Profile | None:
    """Choose the axis near a principal axis around which the mesh is most circular; None without an axis."""
    vertices = mesh.vertices
    profiles: list[tuple[float, Profile]] = []
    for near in np.linalg.eigh(np.cov(vertices.T))[1].T:
        axis = body_axis(mesh, near)
        if axis is None:
            continue
        middle = mesh.bounds.mean(0)
        for _ in range(2):  # centre the mesh perpendicular to the axis
            across = vertices - middle - ((vertices - middle) @ axis)[:, None] * axis
            middle = middle + across.mean(0)
        profiles.append(_profile_around(mesh, middle, axis, settings.outer_quantile, settings))
    return min(profiles, key=lambda profile: profile[0])[1] if profiles else None


def _profile_around(
    mesh: TriangleMesh,
    middle: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    quantile: float,
    settings: RevolutionSettings,
) -> tuple[float, Profile]:
    """Measure the radii of a mesh around an axis.

    Args:
        mesh: surface.
        middle: point on the axis.
        axis: unit direction.
        quantile: quantile of the distances of vertices from the axis at each height.
        settings: number of radii, and of those that are extrapolated.

    Returns:
        Mean deviation from a body of revolution, relative to the mean radius, and the body.
    """
    knots, end = settings.knots, settings.end_knots
    offset = mesh.vertices - middle
    along = offset @ axis
    radius, low, high = np.linalg.norm(offset - along[:, None] * axis, axis=1), along.min(), along.max()
    number = ((along - low) / (high - low) * (knots - 1)).round().astype(np.int64)
    filled = np.unique(number)
    radii = np.interp(np.arange(knots), filled, [np.quantile(radius[number == knot], quantile) for knot in filled])
    radii[:end], radii[-end:] = radii[end], radii[-end - 1]
    spread = np.abs(radius - radii[number])[(number > end) & (number < knots - end)].mean() / radii.mean()
    foot, direction, outline = (torch.from_numpy(part).float() for part in (middle + low * axis, axis, radii))
    return float(spread), Profile(foot, direction, torch.tensor(float(high - low)), outline)


def _rays(
    silhouettes: Silhouettes, settings: RevolutionSettings
) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points 3"], Float[Tensor, " points"], Float[Tensor, " points"]]:
    """Sample rays on the outlines of the masks and on both sides.

    Returns:
        Origins, unit directions, the width of a pixel at unit distance, and the side: 0 on the outline, 1 outside, -1
        inside.
    """
    cameras, random = silhouettes.cameras, np.random.default_rng(0)
    views, pixels, sides = [], [], []
    for view, distance in enumerate(silhouettes.distances.numpy()):
        outside = np.argwhere((distance < -settings.near) & (distance > -settings.far)).astype(np.float32)
        inside = np.argwhere(distance > settings.near).astype(np.float32)
        for side, points, count in (
            (0.0, _outline_points(distance, settings.border), settings.outline_points),
            (1.0, outside, settings.side_points),
            (-1.0, inside, settings.side_points),
        ):
            drawn = points[random.permutation(len(points))[:count]]
            views.append(torch.full((len(drawn),), view))
            pixels.append(torch.from_numpy(drawn))
            sides.append(torch.full((len(drawn),), side))
    of_view, position = torch.cat(views), torch.cat(pixels)
    # Integers are pixel centres here.
    rays = cameras.rays(of_view, position[:, 0], position[:, 1])
    width = 1 / (0.5 * (cameras.fx + cameras.fy))[of_view]
    return rays.origins.float(), rays.directions.float(), width, torch.cat(sides)


def _outline_points(distances: Float[np.ndarray, "H W"], border: int) -> Float[np.ndarray, "points 2"]:
    """Find points (row, column) of the outline on the lines between adjacent pixel centres, away from the border."""
    points = np.concatenate([np.empty((0, 2)), *find_contours(distances, 0)]).astype(np.float32)
    last = np.array(distances.shape) - 1 - border
    return points[((points >= border) & (points <= last)).all(1)]
