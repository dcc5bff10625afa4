"""A surface refined from what is seen through it.

Each step traces some pixels of the object and compares the known surroundings, where the rays leave, with what the
pixels show; the replay of the paths says how the surface has to move. Outlines of masks, or of the surface it begins
with, stay where they are. Photographs and surroundings begin coarse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerfro.capture.learned_distance import LearnedDistance
from nerfro.capture.surroundings import Pixels, Surroundings
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.interpolation import intersect_box, quadratic_spline
from nerfro.media.sdf_grid import SdfGrid
from nerfro.pixel_parts import pixel_rays
from nerfro.samplers.replay import smallest_cosine
from nerfro.samplers.snell import Snell

# Pixels of the object, and of outlines, of a step.
_PIXELS, _OUTLINE_PIXELS = 6000, 2000
# Least |N . d| of a path whose derivatives are learned from.
_STEADY = 0.15
# Residuals count half at this share of the surroundings' standard deviation.
_HALF = 0.4
# Pixels whose centres are within so many pixels of an outline, and the misfit that counts half, pixels.
_REACH, _MISFIT = 1.5, 0.5
_MASK_WEIGHT, _ROUGHNESS_WEIGHT = 0.3, 0.3
# Of Adam, as the tilt of the surface by a step, radians, at the beginning and the end of a stage: a grid may move as
# much as its cells are wide times that. Ten times as much diverges.
_RATES = (4e-4, 4e-5)
# Places on a ray at which the distance to the surface is looked for.
_PLACES = 64


@dataclass(frozen=True)
class Stage:
    """A resolution of photographs and surroundings, and what is learned at it.

    Attributes:
        through: pixels that the object fills.
        surroundings: as they are seen at that resolution.
        steps: of descent.
        max_events: paths with more are left out.
    """

    through: Pixels
    surroundings: Surroundings
    steps: int
    max_events: int


class OutlinePixels:
    """Pixels near the outlines of masks, and how far from the outline their centres are."""

    def __init__(self, silhouettes: Silhouettes) -> None:
        near = (silhouettes.distances.abs() < _REACH) & ~silhouettes.cut[:, None, None]
        self._cameras, self._index = silhouettes.cameras, near.flatten().nonzero()[:, 0]
        self._distances = silhouettes.distances.flatten()[self._index]

    def misfit(self, medium: SdfGrid, generator: torch.Generator) -> Float[Tensor, ""]:
        """Robust mean of the difference between the rays' distances to the surface and to the masks' outlines.

        The least signed distance on a ray that passes the surface is how far from its outline it is seen. Where on the
        ray that is needs no gradient: there the distance does not change along it.
        """
        drawn = torch.randint(len(self._index), (_OUTLINE_PIXELS,), generator=generator)
        rays = pixel_rays(self._cameras, self._index[drawn])
        with torch.no_grad():
            enter, leave = intersect_box(medium.box, rays.origins, rays.directions)
            share = torch.linspace(0, 1, _PLACES)
            t = enter[:, None] + share * (leave - enter)[:, None]
            for _ in range(2):
                found = _coarse_distance(medium, rays.origins[:, None] + t[..., None] * rays.directions[:, None])
                best = t.gather(1, found.argmin(1, keepdim=True))
                width = (t[:, -1:] - t[:, :1]) / (_PLACES - 1)
                t = best + (2 * share - 1) * width
            best = best[:, 0]
            known = enter < leave
        phi, _ = quadratic_spline(medium.coefficients[0], medium.box, rays.origins + best[:, None] * rays.directions)
        view = self._index[drawn] // (self._cameras.height * self._cameras.width)
        pixel = best / self._cameras.fx[view]
        square = (phi / pixel + self._distances[drawn])[known].square()
        return (square / (square + _MISFIT**2)).mean()


def refine(
    distance: LearnedDistance,
    stages: list[Stage],
    outlines: OutlinePixels,
    ior: float,
    judge: Callable[[int], bool],
    begin: int = 0,
) -> None:
    """Descend stage after stage.

    Args:
        distance: learns.
        stages: coarse to fine.
        outlines: stay where they are.
        ior: of the body.
        judge: is told after each step how many are done, of all stages; says whether the stage is to go on.
        begin: number of steps that were done before.
    """
    ended = 0
    for stage in stages:
        begun, ended = ended, ended + stage.steps
        first, last = _RATES
        cells = [float(distance.box[1, 0] - distance.box[0, 0]) / (len(grid[0, 0]) - 1) for grid in distance.offsets]
        optimizer = torch.optim.Adam([{"params": [grid]} for grid in distance.offsets], first, betas=(0.9, 0.99))
        for step in range(max(begun, begin), ended):
            turn = math.pi * (step - begun) / stage.steps
            for group, cell in zip(optimizer.param_groups, cells, strict=True):
                group["lr"] = cell * (last + (first - last) * 0.5 * (1 + math.cos(turn)))
            generator = torch.Generator().manual_seed(step)
            offset = distance.offset()
            medium = distance.medium([ior], offset)
            drawn = stage.through[torch.randint(len(stage.through), (_PIXELS,), generator=generator)]
            loss = seen_error(medium, drawn, stage, learn=True)[0].mean()
            loss = loss + _MASK_WEIGHT * outlines.misfit(medium, generator)
            loss = loss + _ROUGHNESS_WEIGHT * distance.roughness(offset)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if not judge(step + 1):
                break


def seen_error(
    medium: SdfGrid, pixels: Pixels, stage: Stage, learn: bool
) -> tuple[Float[Tensor, "K"], Bool[Tensor, "P"]]:
    """Robust errors r^2 / (r^2 + s^2) of what pixels show, and of which K pixels; with gradients where it `learn`s."""
    rays, sampler = pixels.rays, Snell(max_events=stage.max_events)
    trace = sampler.trace(rays, medium)
    used = trace.path.refracted & ~trace.exceeded
    if learn:
        used &= smallest_cosine(trace.path, medium) > _STEADY
    path, rays = trace.path[used], rays[used]
    if learn:
        path = sampler.refine(path, rays, medium)
    radiance, known = stage.surroundings.radiance(path.exits())
    used[used.clone()] = known
    error = (radiance[known] - pixels.radiance[used]).square().mean(-1)
    square = (_HALF * float(stage.surroundings.colours.std(0).mean())) ** 2 + 1e-6
    return error / (error + square), used


def _coarse_distance(medium: SdfGrid, points: Float[Tensor, "P K 3"]) -> Float[Tensor, "P K"]:
    """Trilinear signed distance."""
    place = 2 * (points - medium.box[0]) / (medium.box[1] - medium.box[0]) - 1
    grid = place.flip(-1)[None, :, :, None]
    return functional.grid_sample(medium.distances[None], grid, padding_mode="border", align_corners=True)[0, 0, ..., 0]
