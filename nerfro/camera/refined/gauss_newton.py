"""Gauss-Newton steps that align cameras with their photographs while the scene is fixed.

Hundreds of pixels of a photograph determine the six parameters of its camera, so one Gauss-Newton step replaces many
gradient steps with few pixels. Cameras are coupled by the common lens and by priors from panorama and silhouettes.
Derivatives are finite differences of rendered colours over about a pixel. In contrast to automatic differentiation,
these include moving silhouettes and ignore details below a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from nerfro.camera.refined.refined import RefinedCamera, object_distances
from nerfro.core.cameras import Cameras
from nerfro.core.rays import Rays
from nerfro.core.robust import geman_mcclure_weight
from nerfro.samplers.subdivision import contrast, pixel_rays

TINY = 1e-9  # lower bound of divisors

# Rendered colours of rays, sRGB in [0, 1], with the exposure of the views.
Render = Callable[[Rays, Int[Tensor, "R"]], Float[Tensor, "R 3"]]
# Colours [R, 3] of pixels in the photographs.
Photographed = Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]]


@dataclass(frozen=True)
class PriorInformation:
    """Gaussian prior of the parameters of all cameras.

    Attributes:
        mean: mean of the parameters in pixels: six per camera, followed by the lens if it is refined (see
            `RefinedCamera.parameter_vector`).
        information: information matrix, the inverse of the covariance; zero for directions without information.
    """

    mean: Float[Tensor, " parameters"]
    information: Float[Tensor, "parameters parameters"]


def axes_across(directions: Float[Tensor, "R 3"]) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Return two unit axes that are perpendicular to each direction and to each other."""
    least = one_hot(directions.abs().argmin(-1), 3).to(directions)
    first = normalize(torch.linalg.cross(directions, least), dim=-1)
    return first, torch.linalg.cross(directions, first)


def shortened(steps: Float[Tensor, "*steps N"], longest: float) -> Float[Tensor, "*steps N"]:
    """Shorten vectors to a largest length."""
    return steps * (longest / steps.norm(dim=-1, keepdim=True).clamp(min=TINY)).clamp(max=1)


def robust_weights(error: Float[Tensor, "R 3"], scale: float) -> Float[Tensor, "R"]:
    """Compute Geman-McClure weights of errors of three channels.

    In contrast to `nerfro.core.robust`, `scale` refers to the Euclidean norm over the channels, not to their root mean
    square, which is smaller by the square root of 3.
    """
    return geman_mcclure_weight(error, scale / math.sqrt(error.shape[-1]))


def normal_equations(
    slopes: Float[Tensor, "R C parameters"],
    error: Float[Tensor, "R C"],
    weights: Float[Tensor, "R"],
    view: Int[Tensor, "R"],
    num_views: int,
    damping: float = 1e-3,
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M"]]:
    """Accumulate the normal equations of all cameras.

    Args:
        slopes: derivatives of C residuals by N parameters: six of the camera, followed by the shared parameters.
        error: residuals.
        weights: weight of each observation.
        view: index of the camera of each observation.
        num_views: number of cameras V.
        damping: damping relative to the mean of the diagonal, which keeps undetermined parameters unchanged.

    Returns:
        Matrix and gradient for 6 V camera parameters, followed by the shared parameters.
    """
    num = slopes.shape[-1]
    squares = torch.einsum("r,rci,rcj->rij", weights, slopes, slopes)
    products = torch.einsum("r,rci,rc->ri", weights, slopes, error)
    of_views = slopes.new_zeros(num_views, num, num).index_add(0, view, squares)
    gradient = slopes.new_zeros(num_views, num).index_add(0, view, products)
    own, shared = of_views[:, :6, :6], of_views[:, 6:, 6:].sum(0)
    added = damping * own.diagonal(dim1=1, dim2=2).mean(-1) + TINY
    own = own + added[:, None, None] * torch.eye(6).to(own)
    shared = shared + (damping * shared.trace() / max(len(shared), 1) + TINY) * torch.eye(num - 6).to(shared)
    mixed = of_views[:, :6, 6:].flatten(0, 1)
    matrix = torch.cat([torch.block_diag(*own), mixed], 1)
    matrix = torch.cat([matrix, torch.cat([mixed.mT, shared], 1)])
    return matrix, torch.cat([gradient[:, :6].flatten(), gradient[:, 6:].sum(0)])


def with_priors(
    matrix: Float[Tensor, "parameters parameters"],
    vector: Float[Tensor, " parameters"],
    parameters: Float[Tensor, " parameters"],
    variance: Float[Tensor, ""] | float,
    priors: Iterable[PriorInformation],
) -> tuple[Float[Tensor, "parameters parameters"], Float[Tensor, " parameters"]]:
    """Add priors to normal equations.

    Args:
        matrix, vector: matrix and gradient of the normal equations.
        parameters: current parameters in pixels.
        variance: variance of the residuals, which scales the priors.
        priors: priors of the parameters.
    """
    for prior in priors:
        # Checkpoints are read to the CPU.
        information = variance * prior.information.to(matrix)
        matrix = matrix + information
        vector = vector + information @ (parameters - prior.mean.to(parameters)).to(vector)
    return matrix, vector


@dataclass(frozen=True)
class Step:
    """Settings of a Gauss-Newton step.

    Attributes:
        difference_pixels: distance of the finite differences in pixels.
        scale: scale of the robust loss, see `robust_weights`, sRGB.
        max_pixels: maximum motion of a camera, and maximum change of the lens, in pixels.
        fraction: fraction of the step that is applied.
        steep_slope: colour change per pixel of motion above which the weight decreases, because steep gradients hold
            over short distances.
    """

    difference_pixels: float
    scale: float
    max_pixels: float
    fraction: float = 1.0
    steep_slope: float = 0.1


def gauss_newton_step(
    camera: RefinedCamera,
    cameras: Cameras,
    pixels: Int[Tensor, "R"],
    photographed: Photographed,
    render: Render,
    step: Step,
    priors: Sequence[PriorInformation] = (),
) -> None:
    """Move each camera and change the common lens by one Gauss-Newton step.

    Args:
        camera: estimated cameras, changed in place.
        cameras: cameras of the data set.
        pixels: pixels of all views that are compared.
        photographed: colours of pixels in the photographs.
        render: colours of rays in the current scene.
        step: settings of the step.
        priors: prior information about the cameras.
    """
    view = cameras.view_of(pixels)
    initial, target = pixel_rays(cameras, pixels), photographed(pixels).clamp(0, 1)
    rays = camera(initial, view)
    angle = step.difference_pixels / cameras.fx[view]
    distances = object_distances(cameras).to(angle)[view]
    rendered, by_origin, by_direction = _differences(render, rays, view, angle, distances)
    slopes = camera.slopes(initial, view, by_origin, by_direction)
    error = rendered - target
    # A steep derivative is valid for small motions only, because colours are bounded.
    weights = robust_weights(error, step.scale) / (1 + (slopes[..., :6] / step.steep_slope).square().sum((1, 2)))
    matrix, vector = normal_equations(slopes.double(), error.double(), weights.double(), view, len(cameras))
    variance = (weights[:, None] * error.square()).sum() / (3 * weights.sum()).clamp(min=TINY)
    matrix, vector = with_priors(matrix, vector, camera.parameter_vector(), variance, priors)
    changes = camera.split(-torch.linalg.solve(matrix, vector))
    camera.move(*(step.fraction * shortened(change, step.max_pixels).to(angle) for change in changes))


def informative_pixels(
    candidates: Int[Tensor, "V M"],
    num_pixels: int,
    photographed: Photographed,
    cameras: Cameras,
    excluded: Bool[Tensor, "V M"] | None = None,
    min_contrast: float = 0.03,
) -> Int[Tensor, "R"]:
    """Select pixels of each view for a Gauss-Newton step: candidates with contrast first, in the given order.

    Args:
        candidates: candidate pixels of each view.
        num_pixels: maximum number of pixels per view.
        photographed: colours of pixels in the photographs.
        cameras: cameras of the data set.
        excluded: candidates that must not be selected.
        min_contrast: pixels with a smaller contrast to their neighbours (sRGB) carry no information about the pose.
    """
    flat = (contrast(photographed, cameras, candidates.flatten()) < min_contrast).view(candidates.shape)
    excluded = torch.zeros_like(flat) if excluded is None else excluded
    order = (flat + 2 * excluded).argsort(dim=1, stable=True)[:, :num_pixels]
    return candidates.gather(1, order)[~excluded.gather(1, order)]


def _differences(
    render: Render,
    rays: Rays,
    view: Int[Tensor, "R"],
    angle: Float[Tensor, "R"],
    distances: Float[Tensor, "R"],
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
    """Render colours, and their derivatives by origins and directions of rays (last axis x, y, z).

    Differences are one-sided, with alternating signs from ray to ray, so that second derivatives cancel in sums over
    pixels. Motions along a ray change nothing, so each ray has two rotations and two translations. A translation moves
    the point at the object's distance as far as a rotation by `angle` does.
    """
    d = rays.directions
    rendered, sign = render(rays, view), 1.0 - 2.0 * (torch.arange(len(d), device=d.device) % 2).to(d)
    by_origin, by_direction = (d.new_zeros(len(d), 3, 3) for _ in range(2))
    for axis in axes_across(d):
        step = (sign * angle)[:, None]
        rotated = render(replace(rays, directions=normalize(d + step * axis, dim=-1)), view)
        by_direction += ((rotated - rendered) / step)[:, :, None] * axis[:, None]
        step = step * distances[:, None]
        translated = render(replace(rays, origins=rays.origins + step * axis), view)
        by_origin += ((translated - rendered) / step)[:, :, None] * axis[:, None]
    return rendered, by_origin, by_direction
