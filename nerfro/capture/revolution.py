"""A body of revolution whose outlines are the masks': for what came off a wheel or a lathe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd
from torch.nn import functional
from torch.nn.functional import normalize

from nerfro.capture.upright import body_axis
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.mesh import TriangleMesh

Symmetry = Literal["axis", "auto"]

# Radii along the axis, of a polyline, and triangles around it.
_KNOTS, _SECTIONS = 72, 160
_END = 4  # knots that the hull's ends are not believed in
# Points on the outline of each mask, at most, and pixels inside and outside of it, which are so far from it (pixels).
_POINTS, _BESIDE, _NEAR, _FAR = 100, 40, 3.0, 40.0
# Iterations, and how far an outline may be from the body's in pixels to count half, at first and at last.
_ITERATIONS, _HALVED = 24, (8.0, 1.0)
# How much bends between knots weigh against pixels; a step's longest and shares' smallest parts, in heights.
_BENDING, _LONGEST, _THINNEST = 0.03, 0.03, 1e-3
_EDGE = 0.5  # pixels
# No camera sees a low roof on the top, or a cone below the foot: a pixel less of height is worth so many outlines.
_FLAT = 0.003
_STIFF = 10.0  # how much more bends weigh at the ends, where only a thin slice would be seen of them
# Places along a ray that are looked at, and closer ones around the nearest of these; rows and columns of pixels next to
# the frame are no outline.
_PLACES, _CLOSER, _FRAME = 48, 12, 2


@dataclass(frozen=True)
class Profile:
    """A body of revolution: `radii` at evenly spaced heights along a unit `axis` from `foot`; flat ends.

    Its edges there are rounded by about `edge`.
    """

    foot: Float[Tensor, "3"]
    axis: Float[Tensor, "3"]
    height: Float[Tensor, ""]
    radii: Float[Tensor, "K"]
    edge: float = 0.0

    def in_plane(self, points: Float[Tensor, "*P 3"]) -> tuple[Float[Tensor, "*P"], Float[Tensor, "*P"]]:
        """Distance from the axis, and height over the foot."""
        offset = points - self.foot
        along = offset @ self.axis
        return (offset - along[..., None] * self.axis).square().sum(-1).clamp(min=1e-20).sqrt(), along

    def distance(self, points: Float[Tensor, "*P 3"]) -> Float[Tensor, "*P"]:
        """About the signed distance, negative inside; exact where it is zero."""
        radius, along = self.in_plane(points)
        step = self.height / (len(self.radii) - 1)
        place = (along / step).clamp(0, len(self.radii) - 1.001)
        low = place.floor().long()
        first, second = self.radii[low], self.radii[low + 1]
        slope = ((second - first) / step).detach()
        side = (radius - torch.lerp(first, second, place - low)) / (1 + slope.square()).sqrt()
        # Rounded at the edges, so that the least distance along a ray depends on both surfaces that meet there.
        return self.edge * torch.logsumexp(torch.stack([side, -along, along - self.height]) / self.edge, 0)

    def mesh(self) -> TriangleMesh:
        """Closed, outward faces counter-clockwise."""
        axis = self.axis.double().numpy()
        across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        across /= np.linalg.norm(across)
        turn = 2 * np.pi * np.arange(_SECTIONS) / _SECTIONS
        around = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * np.cross(axis, across)
        heights = np.linspace(0, float(self.height), len(self.radii))
        rings = self.radii.double().numpy()[:, None, None] * around + heights[:, None, None] * axis
        ends = np.stack([heights[0] * axis, heights[-1] * axis])
        vertices = np.concatenate([rings.reshape(-1, 3), ends]) + self.foot.double().numpy()
        here, there = np.arange(_SECTIONS), np.roll(np.arange(_SECTIONS), -1)
        faces = []
        for ring in range(len(heights) - 1):
            a, b = ring * _SECTIONS, (ring + 1) * _SECTIONS
            faces += [np.stack([a + here, a + there, b + there], 1), np.stack([a + here, b + there, b + here], 1)]
        last, below, above = (len(heights) - 1) * _SECTIONS, len(vertices) - 2, len(vertices) - 1
        faces += [np.stack([there, here, np.full_like(here, below)], 1)]
        faces += [np.stack([last + here, last + there, np.full_like(here, above)], 1)]
        return TriangleMesh(vertices, np.concatenate(faces))


def fit_revolution(
    mesh: TriangleMesh, silhouettes: Silhouettes, progress: Callable[[float], None] = lambda share: None
) -> TriangleMesh | None:
    """The body of revolution near a mesh whose outlines are those of the masks; None where the mesh has no axis.

    A ray through a mask's outline touches the body: along it, the least distance to the body is zero. Beside the
    outline it meets the body or does not. Axis, ends and radii are found by the robust squares of these distances in
    pixels, so an outline that is not the body's, such as that of a thing before it, does not pull. `progress` is told
    the share done.
    """
    start = _first_guess(mesh)
    if start is None:
        return None
    origins, directions, width, side = _rays(silhouettes)
    middle, size = start.foot + 0.5 * start.height * start.axis, start.height
    across = torch.linalg.svd(start.axis[None])[2][1:]
    pixels = float(size / (width * (origins - middle).norm(dim=-1)).median())  # in the height

    # Lengths in heights: two shifts and two turns across the axis, the ends, and the radii.
    def body(numbers: Tensor) -> Profile:
        axis = normalize(start.axis + numbers[2:4] @ across, dim=0)
        foot = middle + size * (numbers[:2] @ across + numbers[4] * axis)
        height, radii = size * (numbers[5] - numbers[4]), size * numbers[6:].clamp(min=_THINNEST)
        return Profile(foot, axis, height, radii, _EDGE * float(size) / pixels)

    def misfits(numbers: Tensor) -> Tensor:
        apart = body(numbers).distance(origins + place[:, None] * directions) / (width * place)
        return torch.where(side * apart > 0, 0.0, apart)

    numbers = torch.cat([torch.zeros(4), torch.tensor([-0.5, 0.5]), start.radii / size])
    bends = functional.pad(torch.eye(_KNOTS).diff(n=2, dim=0), (6, 0))
    bends[:_END] *= _STIFF
    bends[-_END:] *= _STIFF
    for iteration in range(_ITERATIONS):
        done = min(1.0, iteration / (_ITERATIONS - 6))
        halved = _HALVED[0] * (_HALVED[1] / _HALVED[0]) ** done
        place = _nearest_place(body(numbers), origins, directions)
        misfit, slopes = misfits(numbers).double(), jacfwd(misfits)(numbers).double()
        weight = 1 / (1 + (misfit / halved).square()).square()
        stiff = (_BENDING * pixels) ** 2 * len(misfit) / _KNOTS * (bends.T @ bends).double()
        system = slopes.T @ (weight[:, None] * slopes) + stiff
        right = slopes.T @ (weight * misfit) + stiff @ numbers.double()
        right[4:6] += _FLAT * len(misfit) * pixels * torch.tensor([-1.0, 1.0])
        damping = 1e-3 * system.diagonal().mean() * torch.eye(len(numbers)).double()
        step = torch.linalg.solve(system + damping, right)
        numbers = numbers - (step * (_LONGEST / step.abs().max()).clamp(max=1)).float()
        progress((iteration + 1) / _ITERATIONS)
    return body(numbers).mesh()


def _first_guess(mesh: TriangleMesh) -> Profile | None:
    """Of the axes near the mesh's principal ones, that around which it is roundest."""
    vertices = mesh.vertices
    found: list[tuple[float, Profile]] = []
    for near in np.linalg.eigh(np.cov(vertices.T))[1].T:
        axis = body_axis(mesh, near)
        if axis is None:
            continue
        middle = mesh.bounds.mean(0)
        for _ in range(2):  # the middle of the outline across the axis
            across = vertices - middle - ((vertices - middle) @ axis)[:, None] * axis
            middle = middle + across.mean(0)
        across = vertices - middle - ((vertices - middle) @ axis)[:, None] * axis
        along, radius = (vertices - middle) @ axis, np.linalg.norm(across, axis=1)
        low, high = along.min(), along.max()
        number = ((along - low) / (high - low) * (_KNOTS - 1)).round().astype(np.int64)
        # Where the ends are, vertices lie nearer to the axis than the outline.
        outer = np.array(
            [np.quantile(radius[number == k], 0.8) if (number == k).any() else np.nan for k in range(_KNOTS)]
        )
        known = np.isfinite(outer)
        outer = np.interp(np.arange(_KNOTS), np.flatnonzero(known), outer[known])
        outer[:_END], outer[-_END:] = outer[_END], outer[-_END - 1]
        spread = np.abs(radius - outer[number])[(number > _END) & (number < _KNOTS - _END)].mean() / outer.mean()
        foot, along_axis, radii = (torch.from_numpy(part).float() for part in (middle + low * axis, axis, outer))
        found.append((float(spread), Profile(foot, along_axis, torch.tensor(float(high - low)), radii)))
    return min(found, key=lambda each: each[0])[1] if found else None


def _rays(
    silhouettes: Silhouettes,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Rays on the masks' outlines and beside them, the width of a pixel at unit distance, and on which side they are.

    0 on the outline, 1 outside of it, -1 inside.
    """
    cameras, random = silhouettes.cameras, np.random.default_rng(0)
    views, places, sides = [], [], []
    for view, distance in enumerate(silhouettes.distances.numpy()):
        outside = np.argwhere((distance < -_NEAR) & (distance > -_FAR)).astype(np.float32)
        inside = np.argwhere(distance > _NEAR).astype(np.float32)
        for side, points, count in (
            (0.0, _outline_points(distance), _POINTS),
            (1.0, outside, _BESIDE),
            (-1.0, inside, _BESIDE),
        ):
            chosen = points[random.permutation(len(points))[:count]]
            views.append(torch.full((len(chosen),), view))
            places.append(torch.from_numpy(chosen))
            sides.append(torch.full((len(chosen),), side))
    of_view, place = torch.cat(views), torch.cat(places)
    # Whole numbers are pixels' centres.
    rays = cameras.rays(of_view, place[:, 0], place[:, 1])
    width = 1 / (0.5 * (cameras.fx + cameras.fy))[of_view]
    return rays.origins.float(), rays.directions.float(), width, torch.cat(sides)


def _outline_points(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "P 2"]:
    """Where the outline crosses the lines between neighbouring pixels' centres: (row, column), not near the frame."""
    found = []
    for axis in (0, 1):
        first, second = (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])
        places = np.argwhere((first > 0) != (second > 0))
        a, b = (part[tuple(places.T)] for part in (first, second))
        crossing = places.astype(np.float32)
        crossing[:, axis] += a / (a - b)
        found.append(crossing)
    points = np.concatenate(found)
    last = np.array(values.shape) - 1 - _FRAME
    return points[((points >= _FRAME) & (points <= last)).all(1)]


@torch.no_grad()
def _nearest_place(body: Profile, origins: Tensor, directions: Tensor) -> Float[Tensor, "P"]:
    """Where along each ray the body is nearest, or deepest."""
    middle = body.foot + 0.5 * body.height * body.axis
    reach = torch.sqrt((0.5 * body.height) ** 2 + body.radii.max() ** 2)
    place = ((middle - origins) * directions).sum(-1)
    for count in (_PLACES, _CLOSER, _CLOSER):
        candidates = place[:, None] + reach * torch.linspace(-1, 1, count)
        distances = body.distance(origins[:, None] + candidates[..., None] * directions[:, None])
        place = candidates.gather(1, distances.argmin(1, keepdim=True))[:, 0]
        reach = reach * 2 / (count - 1)
    return place
