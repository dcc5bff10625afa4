"""Fit of a body of revolution to the outlines of the masks."""

from __future__ import annotations

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

from nerfro.core.progress import track
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.robust import geman_mcclure_weight
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
            corners.
        flatness: weight of the height relative to the observations: no camera sees a low roof on the top or a cone
            below the foot.
        max_step: longest step, as a fraction of the height.
        min_radius: smallest radius, as a fraction of the height.
        edge: radius of the rounded edges, in pixels.
        hidden_slope: a cone below the foot is cut if its slope exceeds this fraction of the slope that no camera sees
            as an outline.
        edge_ratio: smallest factor by which the slope then decreases at the edge of the foot.
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
    flatness: float = 0.003
    max_step: float = 0.03
    min_radius: float = 1e-3
    edge: float = 0.5
    hidden_slope: float = 0.6
    edge_ratio: float = 0.6
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
    origins, directions, width, side = _rays(silhouettes, settings)
    middle, size = start.foot + 0.5 * start.height * start.axis, start.height
    if ((origins - middle) @ start.axis).mean() < 0:  # the axis points towards the cameras
        start = Profile(start.foot + size * start.axis, -start.axis, size, start.radii.flip(0))
    across = torch.linalg.svd(start.axis[None])[2][1:]
    pixels = float(size / (width * (origins - middle).norm(dim=-1)).median())  # in the height

    # Parameters in units of the height: two translations and two rotations of the axis, both ends, and the radii.
    def body(numbers: Tensor) -> Profile:
        axis = normalize(start.axis + numbers[2:4] @ across, dim=0)
        foot = middle + size * (numbers[:2] @ across + numbers[4] * axis)
        height, radii = size * (numbers[5] - numbers[4]), size * numbers[6:].clamp(min=settings.min_radius)
        return Profile(foot, axis, height, radii, settings.edge * float(size) / pixels)

    def misfits(numbers: Tensor) -> Tensor:
        apart = body(numbers).least_distance(origins + lengths[:, None] * directions) / (width * lengths)
        return torch.where(side * apart > 0, 0.0, apart)

    numbers = torch.cat([torch.zeros(4), torch.tensor([-0.5, 0.5]), start.radii / size])
    knots, end = settings.knots, settings.end_knots
    bends = functional.pad(torch.eye(knots).diff(n=2, dim=0), (6, 0))
    bends[:end] *= settings.end_bending
    bends[-end:] *= settings.end_bending
    first_scale, last_scale = settings.robust_scale
    for iteration in track("finding the axis", range(settings.iterations)):
        done = min(1.0, iteration / (settings.iterations - 6))
        scale = first_scale * (last_scale / first_scale) ** done
        lengths = _nearest_lengths(body(numbers), origins, directions, settings)
        misfit, slopes = misfits(numbers).double(), jacfwd(misfits)(numbers).double()
        weight = geman_mcclure_weight(misfit[:, None], scale)
        smooth = 1 / (1 + (bends @ numbers / settings.corner).square()).square()  # corners have little weight
        smooth[-end:] = 1  # the upper end would flare
        stiff = (settings.bending * pixels) ** 2 * len(misfit) / knots * (bends.T @ (smooth[:, None] * bends)).double()
        system = slopes.T @ (weight[:, None] * slopes) + stiff
        right = slopes.T @ (weight * misfit) + stiff @ numbers.double()
        right[4:6] += settings.flatness * len(misfit) * pixels * torch.tensor([-1.0, 1.0])
        damping = 1e-3 * system.diagonal().mean() * torch.eye(len(numbers)).double()
        step = torch.linalg.solve(system + damping, right)
        numbers = numbers - (step * (settings.max_step / step.abs().max()).clamp(max=1)).float()
    return _without_hidden_cone(body(numbers), origins.unique(dim=0), settings).mesh()


def _without_hidden_cone(body: Profile, centres: Float[Tensor, "cameras 3"], settings: RevolutionSettings) -> Profile:
    """Cut the part below a sharp edge of the foot that hardly any camera sees as an outline, such as a flat cone.

    Args:
        body: fitted body.
        centres: centres of the cameras. They see the foot at larger angles to its plane than the rest of the body.
        settings: limits of the slopes.
    """
    step = body.height / (len(body.radii) - 1)
    slopes = body.radii.diff()[: len(body.radii) // 3] / step
    heights = step * torch.arange(1, len(slopes))
    lines_of_sight = centres - (body.foot + heights[:, None] * body.axis)[:, None]
    least_sine = (normalize(lines_of_sight, dim=-1) @ body.axis).amin(1)
    least_unseen = torch.where(least_sine > 0, (1 / least_sine.square() - 1).clamp(min=0).sqrt(), torch.inf)
    hidden = slopes[:-1] > settings.hidden_slope * least_unseen
    edges = (hidden & (slopes[1:] < settings.edge_ratio * slopes[:-1])).nonzero()
    first = int(edges.max()) + 1 if len(edges) else 0
    foot, height = body.foot + first * step * body.axis, body.height - first * step
    return Profile(foot, body.axis, height, body.radii[first:], body.edge)


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


@torch.no_grad()
def _nearest_lengths(
    body: Profile, origins: Tensor, directions: Tensor, settings: RevolutionSettings
) -> Float[Tensor, " points"]:
    """Find the arc length along each ray at which the distance to the body is smallest."""
    middle = body.foot + 0.5 * body.height * body.axis
    reach = torch.sqrt((0.5 * body.height) ** 2 + body.radii.max() ** 2)
    lengths = ((middle - origins) * directions).sum(-1)
    for count in (settings.ray_samples, settings.closer_samples, settings.closer_samples):
        candidates = lengths[:, None] + reach * torch.linspace(-1, 1, count)
        distances = body.distance(origins[:, None] + candidates[..., None] * directions[:, None])
        lengths = candidates.gather(1, distances.argmin(1, keepdim=True))[:, 0]
        reach = reach * 2 / (count - 1)
    return lengths
