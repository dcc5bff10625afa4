"""Losses on the radiance of pixels and of the background."""

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
from nerfro.data.lazy_images import LazyImages
from nerfro.geometry.space import Space
from nerfro.losses.base import Loss
from nerfro.registry.allowed import NotNegative
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
            absorbed = fixed.transmitted(fixed.far[:, None])[:, 0].clamp(min=1e-30)
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
