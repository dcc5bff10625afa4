"""Cameras that are brought nearer to their photographs with the scene held: one step of Gauss-Newton for each.

A photograph has hundreds of pixels for the six numbers of its camera, and a step of its normal equations is worth
hundreds of steps along gradients of a few pixels. Cameras hang together by the lens that they share, and by what
panorama and outlines have told of them. Derivatives are differences of rendered colours over about a pixel: they see
silhouettes that move, and are not misled by what is finer than a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.camera.least_squares import Told, axes_across, normal_equations, robust_weights, with_told
from nerfro.camera.pixel_units import object_distances
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.rays import Rays
from nerfro.subdivision import contrast, pixel_rays

# Colours, sRGB in [0, 1], that photographs of views would have along rays.
Shown = Callable[[Rays, Int[Tensor, "R"]], Float[Tensor, "R 3"]]
# Colours [R, 3] that photographs have in pixels.
Photographed = Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]]

# Pixels that differ from their neighbours by less (sRGB) tell nothing of where a camera stands.
_LEAST_CONTRAST = 0.03
# Change of colour for a pixel of motion from which a pixel counts less: so steep a slope does not reach far.
_STEEP = 0.1
_TINY = 1e-9


@dataclass(frozen=True)
class Step:
    """How cameras take a step."""

    reach: float  # pixels over which differences are taken
    scale: float  # of the robust error, sRGB: pixels that are off by more count less
    longest: float  # pixels that a camera is moved at most, and the lens is changed
    share: float = 1.0  # of the step that is taken
    checked: bool = True  # whether a camera stays where the error of the same pixels would not fall


def improve(
    camera: RefinedCamera,
    cameras: Cameras,
    pixels: Int[Tensor, "R"],
    photographed: Photographed,
    shown: Shown,
    how: Step,
    told: Sequence[Told] = (),
) -> None:
    """Move each camera, and the lens that all share, by a step towards its photograph.

    Args:
        camera: what is believed of the cameras; it is changed.
        cameras: as the data give them.
        pixels: that are looked at, of all views.
        photographed: their colours in the photographs.
        shown: colours of the scene as it is now.
        how: the step.
        told: what is known of the cameras already.
    """
    view = pixels // (cameras.height * cameras.width)
    given, target = pixel_rays(cameras, pixels), photographed(pixels)
    rays = camera(given, view)
    across = how.reach / cameras.fx[view]
    distances = object_distances(cameras).to(across)[view]
    seen, by_origin, by_direction = _differences(shown, rays, view, across, distances)
    slopes = camera.slopes(given, view, by_origin, by_direction)
    error = seen - target
    # A pixel's derivative holds no farther than its colour can change.
    weights = robust_weights(error, how.scale) / (1 + (slopes[..., :6] / _STEEP).square().sum((1, 2)))
    matrix, vector = normal_equations(slopes.double(), error.double(), weights.double(), view, len(cameras))
    variance = (weights[:, None] * error.square()).sum() / (3 * weights.sum()).clamp(min=_TINY)
    matrix, vector = with_told(matrix, vector, camera.numbers(), variance, told)
    motion, lens = camera.split(-torch.linalg.solve(matrix, vector))
    motion, lens = (
        numbers * (how.longest / numbers.norm(dim=-1, keepdim=True).clamp(min=_TINY)).clamp(max=1)
        for numbers in (motion, lens)
    )
    before = camera.position()
    camera.move(how.share * motion.to(across), how.share * lens.to(across))
    if not how.checked:
        return

    new = _robust(shown(camera(given, view), view) - target, how.scale, view, len(cameras))
    old = _robust(error, how.scale, view, len(cameras))
    camera.move_back(before, worse=new >= old, lens=bool(new.sum() >= old.sum()))


def _robust(error: Float[Tensor, "R 3"], scale: float, view: Int[Tensor, "R"], num_views: int) -> Float[Tensor, "V"]:
    """Error of each view: large ones of single pixels count as one."""
    squares = (error / scale).square().sum(-1)
    return squares.new_zeros(num_views).index_add(0, view, squares / (1 + squares))


def telling(
    candidates: Int[Tensor, "V M"],
    num_pixels: int,
    photographed: Photographed,
    cameras: Cameras,
    useless: Bool[Tensor, "V M"] | None = None,
) -> Int[Tensor, "R"]:
    """Pixels of each view, of those that are offered and not useless: the first that have contrast, else the first."""
    flat = (contrast(photographed, cameras, candidates.flatten()) < _LEAST_CONTRAST).view(candidates.shape)
    useless = torch.zeros_like(flat) if useless is None else useless
    order = (flat + 2 * useless).argsort(dim=1, stable=True)[:, :num_pixels]
    return candidates.gather(1, order)[~useless.gather(1, order)]


def _differences(
    shown: Shown,
    rays: Rays,
    view: Int[Tensor, "R"],
    across: Float[Tensor, "R"],
    distances: Float[Tensor, "R"],
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
    """Colours, and their derivatives by origins and directions of rays, last axis x, y, z.

    One-sided differences, for every second ray to the other side, so that curvature cancels in sums over pixels. Along
    a ray nothing changes, so each has four. Origins are shifted as far as directions turn, at the distances.
    """
    d = rays.directions
    seen, side = shown(rays, view), 1.0 - 2.0 * (torch.arange(len(d), device=d.device) % 2).to(d)
    by_origin, by_direction = (d.new_zeros(len(d), 3, 3) for _ in range(2))
    for axis in axes_across(d):
        step = (side * across)[:, None]
        turned = shown(replace(rays, directions=normalize(d + step * axis, dim=-1)), view)
        by_direction += ((turned - seen) / step)[:, :, None] * axis[:, None]
        step = step * distances[:, None]
        shifted = shown(replace(rays, origins=rays.origins + step * axis), view)
        by_origin += ((shifted - seen) / step)[:, :, None] * axis[:, None]
    return seen, by_origin, by_direction
