"""Losses on the radiance and depth of pixels, on the background, and on the density along paths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from annotated_types import Gt, Lt
from jaxtyping import Bool, Float
from omegaconf import DictConfig
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.core.distributed import rank_and_size, sum_over_processes
from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch, Exits, Rendering
from nerfro.data.base import Views
from nerfro.data.image_files import DEPTH
from nerfro.data.lazy_images import LazyImages
from nerfro.geometry.space import Space
from nerfro.losses.base import Loss
from nerfro.registry.allowed import NotNegative, Positive, Share
from nerfro.registry.registration import register
from nerfro.rendering import Scene

# Random pairs of directions for each step.
_NUM_PAIRS = 1024


@register("loss", "photometric")
class Photometric(Loss):
    """Compute the mean squared colour error of all sampling levels (paper, Eqn. 7).

    The mean is over pixels and channels, as in the authors' code; the norm in the paper is three times larger.

    Args:
        coarse: factor of the errors of coarser levels; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(self, coarse: NotNegative = 1.0) -> None:
        super().__init__()
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        value = batch.rgb.new_zeros(())
        for rendering, factor in zip(renderings, [self.coarse] * (len(renderings) - 1) + [1.0], strict=True):
            radiance = batch.per_pixel(rendering.radiance)
            value = value + factor * mse_loss(*scene.colour_space.prediction_and_target(radiance, batch.rgb))
        return value


@register("loss", "background")
class BackgroundRegularizer(Loss):
    """Penalize |T C'(d) - C| where the final transmittance T is above 1/2 (paper, Eqn. 8).

    The background should explain such pixels without the field, so the loss removes fog in front of the surface. Only
    the density of the finest level learns, because the colour of the background is detached. Channels are summed, and
    the sum over pixels is divided by the number of counted pixels plus one, as in the authors' code.

    In absorbing media, C' includes the absorption, and dark fog in the body has the effect of a grey absorption.
    Therefore |C'(d) - C| is added, in which fog has no part, and from which only a learned absorption learns.

    Args:
        refracted_only: whether to count only rays that meet the medium.
    """

    weight, start, ramp = 0.003, 100, 100

    def __init__(self, refracted_only: bool = True) -> None:
        super().__init__()
        self.refracted_only = refracted_only

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        fine = renderings[-1]
        path = fine.path
        # Pixels count if their final transmittance is above one half, as in the paper.
        counted = batch.per_pixel(path.sum_polylines(fine.transmittance.detach())) > 0.5
        if self.refracted_only:
            counted = counted & (batch.per_pixel(path.main_polyline(path.refracted).to(fine.radiance)) > 0.5)
        light = fine.background_radiance.detach()
        error = self._error(path.sum_polylines(fine.transmittance[:, None] * light), batch, scene)
        if path.record is not None and path.record.absorption.requires_grad:
            fixed = replace(path, s=path.s.detach())
            # The quotient of zeros would not be a number.
            absorbed = fixed.whole_transmittance().clamp(min=1e-30)
            error = error + self._error(path.sum_polylines(light * (absorbed / absorbed.detach())), batch, scene)
        # Gradients are averaged over processes, so each process multiplies its sum by the number of processes.
        return (error * counted).sum() * rank_and_size()[1] / (sum_over_processes(counted.sum()) + 1)

    def _error(self, background: Float[Tensor, "R 3"], batch: Batch, scene: Scene) -> Float[Tensor, "Q"]:
        predicted, target = scene.colour_space.prediction_and_target(batch.per_pixel(background), batch.rgb)
        return (predicted - target).abs().sum(-1)


@register("loss", "total_variation")
class TotalVariation(Loss):
    """Penalize absolute differences of the background colour between random directions at a fixed angle.

    Unlike `smoothness`, which squares differences, the loss does not prefer many small steps to one edge (Rudin, Osher
    and Fatemi, 1992), and covers the whole sphere, including directions in which no training ray leaves.

    Args:
        angle: angle between the two directions in degrees. None takes two texels of the finest level of the background
            that gradient descent learns.
    """

    weight = 3e-3

    def __init__(self, angle: Annotated[float, Gt(0), Lt(90)] | None = None) -> None:
        super().__init__()
        self.angle = angle

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        # 150 small operators, which the CPU takes while a GPU is busy.
        numbers = batch.draws.uniform(torch.arange(_NUM_PAIRS), 3, "total variation")
        # Two directions are two texels or details of the background apart.
        angle = 2 * scene.background.detail if self.angle is None else self.angle
        first, second = direction_pairs(numbers, math.radians(angle))
        directions = torch.cat([first, second]).to(batch.rgb.device, non_blocking=True)
        rgb = scene.colour_space.to_srgb(scene.background(Exits(directions)))
        return (rgb[_NUM_PAIRS:] - rgb[:_NUM_PAIRS]).abs().mean()


def direction_pairs(
    numbers: Float[Tensor, "directions 3"], angle: float
) -> tuple[Float[Tensor, "directions 3"], Float[Tensor, "directions 3"]]:
    """Map uniform numbers in [0, 1) to pairs of unit directions that are `angle` radians apart.

    The first direction is uniform on the sphere, and the second is uniform on the circle around the first.
    """
    z = 2 * numbers[:, 0] - 1
    azimuth, turn = (2 * math.pi * numbers[:, 1:]).unbind(-1)
    cosine, sine, radius = azimuth.cos(), azimuth.sin(), (1 - z.square()).clamp(min=0).sqrt()
    first = torch.stack([radius * cosine, radius * sine, z], -1)
    # Unit vectors along the meridian and along the parallel of the first direction.
    south, east = torch.stack([z * cosine, z * sine, -radius], -1), torch.stack([-sine, cosine, 0 * z], -1)
    tangent = turn.cos()[:, None] * south + turn.sin()[:, None] * east
    return first, math.cos(angle) * first + math.sin(angle) * tangent


# Least fraction of the border of an image that shows the backdrop, of such images, and of all pixels that show the
# backdrop. The dark corners of a lens are smaller, and the border of a photographed room has several colours.
_OF_BORDER, _OF_IMAGES, _OF_PIXELS = 0.9, 0.8, 0.3


def shows(rgb: Float[Tensor, "*batch 3"], backdrop: Float[Tensor, "3"]) -> Bool[Tensor, "*batch"]:
    """Return which pixels have the colour of the backdrop."""
    # The tolerance is one level of 255, plus rounding errors.
    return ((rgb - backdrop).abs() < 1.5 / 255).all(-1)


@register("loss", "backdrop")
class Backdrop(Loss):
    """Penalize the opacity of rays whose pixels show a plain backdrop.

    White density in front of a white backdrop contradicts no photograph. Without this loss, such density remains where
    few cameras look, and hides the object from other directions.

    Args:
        colour: colour of the backdrop, sRGB in [0, 1], which becomes the background. None derives it from the training
            views; the loss is 0 for views without a plain backdrop.
    """

    colour: Float[Tensor, "3"] | None

    weight = 0.1

    def __init__(self, colour: Sequence[float] | None = None) -> None:
        super().__init__()
        if colour is not None and (len(colour) != 3 or not all(0 <= value <= 1 for value in colour)):
            raise NerfroError(f"loss=backdrop: colour={list(colour)} is no sRGB colour; give three numbers in [0, 1]")
        self.register_buffer("colour", None if colour is None else torch.tensor(colour), persistent=False)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        return {"colour": find_backdrop(views.images)} if settings.loss.backdrop.get("weight", cls.weight) else {}

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        if self.colour is None:
            return batch.rgb.new_zeros(())
        rendering = renderings[-1]
        stopped = rendering.path.sum_polylines(1 - rendering.transmittance)
        return (batch.per_pixel(stopped) * shows(batch.rgb, self.colour)).mean()


def find_backdrop(images: LazyImages | Float[Tensor, "V H W 3"]) -> list[float] | None:
    """Return the colour (sRGB in [0, 1]) of the plain backdrop of nearly all images, or None."""
    step = max(1, len(images) // 8)  # a backdrop is searched in eight images or a few more
    examined = [images[view] for view in range(0, len(images), step)]
    borders = [image[_border(*image.shape[:2])] for image in examined]
    colour = torch.stack([of_one.median(0).values for of_one in borders]).median(0).values
    cut_out = torch.tensor([float(shows(of_one, colour).double().mean()) >= _OF_BORDER for of_one in borders])
    share = torch.stack([shows(image, colour).double().mean() for image in examined]).median()
    is_shown = float(colour.min()) >= 0 and float(colour.max()) <= 1  # photographs in linear light may exceed 1
    return colour.tolist() if is_shown and cut_out.double().mean() >= _OF_IMAGES and share >= _OF_PIXELS else None


def _border(height: int, width: int) -> Bool[Tensor, "H W"]:
    """Select the outermost pixels of an image."""
    outermost = torch.ones(height, width, dtype=torch.bool)
    outermost[1:-1, 1:-1] = False
    return outermost


@register("loss", "distortion")
class Distortion(Loss):
    """Penalize weights of the finest level that are spread along a path, as in fog (mip-NeRF 360, Eqn. 15).

    Arc length is measured in units of the length of the path, far - near, so that the loss does not depend on the scale
    of the scene. If space is contracted, contracted length is measured in units of its value at the last edge of the
    samples, where the final transmittance counts as a weight, because the loss would otherwise favour transparency.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        weights, edges = rendering.weights, rendering.samples.edges
        near, far = rendering.path.near[:, None], rendering.path.far[:, None]
        if (contracted_edges := rendering.samples.contracted_edges) is not None:
            near, far = torch.zeros_like(near), contracted_edges[:, -1:]
            weights = torch.cat([weights, rendering.transmittance[:, None]], -1)
            edges = torch.cat([contracted_edges, far], -1)
        # Paths of zero length have no weights; the clamp avoids a division by zero.
        edges = (edges - near) / (far - near).clamp(min=1e-6)
        return batch.per_pixel(rendering.path.sum_polylines(distortion(weights, edges))).mean()


def distortion(weights: Float[Tensor, "P N"], edges: Float[Tensor, "P N+1"]) -> Float[Tensor, "P"]:
    """Integrate w(u) w(v) |u - v| over u and v, for weights that are constant in their intervals.

    The integral is sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (e_{i+1} - e_i), with interval midpoints m (mip-NeRF
    360, Eqn. 15). Because midpoints ascend, the double sum is twice the sum over i of w_i (m_i W_i - M_i), where W_i
    and M_i are the sums of w_j and w_j m_j over j < i, and takes linear time.

    Args:
        weights: rendering weights of the intervals.
        edges: bounds of the intervals, ascending.
    """
    midpoints = 0.5 * (edges[:, 1:] + edges[:, :-1])
    # Only distances matter. Positions relative to the mean reduce cancellation between the two sums.
    midpoints = midpoints - midpoints.mean(-1, keepdim=True)
    moments = weights * midpoints
    weights_before = weights.cumsum(-1) - weights
    moments_before = moments.cumsum(-1) - moments
    between = 2 * (weights * (midpoints * weights_before - moments_before)).sum(-1)
    within = (weights.square() * (edges[:, 1:] - edges[:, :-1])).sum(-1) / 3
    return between + within


@register("loss", "near_camera")
class NearCamera(Loss):
    """Penalize density close to the cameras, with a weight that decreases with the distance.

    The weight of a sample at arc length s is max(1 - s / (r d), 0), where d is the distance of the camera from the
    centre of the space of the run and r the reach. Few rays cross the space close to a camera. Floating density in
    this space contradicts no photograph, but hides the scene from other directions. The loss is similar to the
    occlusion loss of FreeNeRF (Yang et al. 2023, Eqn. 8).

    Args:
        reach: fraction of the way from the camera to the centre where the penalty ends. A larger reach makes the front
            of the scene transparent.
    """

    weight = 1e-1
    needs_box = True

    def __init__(self, reach: Share = 0.5) -> None:
        super().__init__()
        self.reach = reach

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path = rendering.path
        cameras = (path.positions[:, 0] - path.near[:, None] * path.directions[:, 0]).detach()
        farthest = self.reach * (cameras - scene.space.centre).norm(dim=-1).clamp(min=1e-6)
        closeness = (1 - rendering.samples.s / farthest[:, None]).clamp(min=0)
        return batch.per_pixel(path.sum_polylines((rendering.weights * closeness).sum(-1))).mean()


@register("loss", "opaque")
class Opaque(Loss):
    """Penalize the squared final transmittance of each ray, for fields that cover all of space.

    Without this loss, a background of constant colour would replace objects of the same colour. The loss is the
    expected squared error that a background of random grey levels (variance 1) would cause.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        passed = renderings[-1].transmittance.square()
        return batch.per_pixel(renderings[-1].path.sum_polylines(passed)).mean()


@register("loss", "depth")
class Depth(Loss):
    """Penalize the relative distance between the point at which a ray ends and the depth of its pixel.

    A ray ends in the interval of sample i with the probability w_i, and in the background with the final transmittance
    T. The loss is the expected relative error sum_i w_i min(|m_i - D| / D, limit) + T limit at the finest level, where
    m_i is the middle of the interval and D is the arc length in `batch.maps["depth"]`. It is averaged over the pixels
    whose D is positive.

    Args:
        limit: largest relative error that counts, which bounds the influence of wrong depths.
        refracted: whether pixels count whose rays meet the medium. Depth cameras and structure from motion assume
            straight rays, so their depths are wrong there.
    """

    weight = 0.1

    def __init__(self, limit: Positive = 1.0, refracted: bool = False) -> None:
        super().__init__()
        self.limit, self.refracted = limit, refracted

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        """Refuse data without depths."""
        if DEPTH not in views.maps:
            raise NerfroError(
                "loss=depth needs depths, which the data lack; set data.depths=true (data=colmap) or data.depth_unit "
                "(data=nerfstudio with depth_file_path), or return Views(maps={'depth': ...}) in your data format"
            )
        return {}

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path, edges = rendering.path, rendering.samples.edges
        depth = batch.maps[DEPTH][:, 0]
        counts = depth > 0
        if not self.refracted:
            counts = counts & (batch.per_pixel(path.main_polyline(path.refracted).to(depth)) == 0)
        of_path = path.broadcast_to_polylines(torch.where(depth > 0, depth, 1.0)[batch.ray_pixel])[:, None]
        middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
        errors = ((middles - of_path).abs() / of_path).clamp(max=self.limit)
        expected = (rendering.weights * errors).sum(-1) + rendering.transmittance * self.limit
        per_pixel = batch.per_pixel(path.sum_polylines(expected))
        # Gradients are averaged over processes, as in `BackgroundRegularizer`.
        return (per_pixel * counts).sum() * rank_and_size()[1] / sum_over_processes(counts.sum()).clamp(min=1)
