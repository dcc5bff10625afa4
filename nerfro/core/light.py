"""Conversion between linear radiance, which is additive, and sRGB, the encoding of images (IEC 61966-2-1)."""

from __future__ import annotations

import math
from enum import Enum
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import softplus

Colour = Literal["linear", "hdr", "srgb"]  # see `ColourSpace`
Values = TypeVar("Values", Tensor, np.ndarray)  # of any shape
GREY = 0.5 / math.log(2)  # Softplus of 0 is log 2.
# The slope of `_LOG_SLOPE` log(c + `_LOG_OFFSET`) is that of sRGB, 12.92 at black and 0.44 at white.
_LOG_SLOPE, _LOG_OFFSET = 0.455, 0.0352


def to_linear(srgb: Values) -> Values:
    """Decode sRGB to linear radiance; 1 is the maximum of an image."""
    if isinstance(srgb, np.ndarray):
        return to_linear(_tensor(srgb)).numpy()
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Values) -> Values:
    """Encode linear radiance as sRGB; the curve continues beyond 1, so that gradients do not vanish."""
    if isinstance(linear, np.ndarray):
        return to_srgb(_tensor(linear)).numpy()
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def tone_mapped(radiance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Map linear radiance L to the sRGB value of L / (1 + L), in [0, 1) (Reinhard et al., SIGGRAPH 2002, Eqn. 3)."""
    radiance = radiance.clamp(min=0)
    return to_srgb(radiance / (1 + radiance))


def encode_photograph(radiance: Values) -> Values:
    """Encode a photograph in linear light as sRGB that continues below 0 and beyond 1.

    Radiance 1 becomes exactly 1, the value of saturated pixels; see `saturated`.
    """
    if isinstance(radiance, np.ndarray):
        return encode_photograph(_tensor(radiance)).numpy()
    is_saturated = torch.isclose(radiance, torch.ones_like(radiance), rtol=1e-6, atol=0)  # also a mean of ones
    return torch.where(is_saturated, 1.0, to_srgb(radiance))


def saturated(photograph: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
    """Return which values of a photograph, linear or sRGB, are saturated: 1. Greater values were measured."""
    return photograph == 1


def unbounded_radiance(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Map raw numbers to radiance by the square of a softplus that is 0.5 at 0; the square approximates sRGB."""
    return (softplus(raw.float()) * GREY).square()


def clipped_alike(target: Float[Tensor, "*batch"], prediction: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Replace saturated targets by the prediction (without gradient) if the prediction is saturated, too.

    The true value of a saturated pixel is unknown and at least 1, so a brighter prediction is not wrong. If only the
    prediction is saturated, the target remains.
    """
    return torch.where(saturated(target) & (prediction > 1), prediction.detach(), target)


def _tensor(values: np.ndarray) -> Tensor:
    # torch does not support negative strides.
    return torch.from_numpy(np.asarray(values, order="C"))


class ColourSpace(Enum):
    """Colour space in which fields and background return radiance, and rays sum radiance."""

    LINEAR = "linear"
    SRGB = "srgb"  # as in the authors' code
    HDR = "hdr"  # linear, and photographs in linear light, which may exceed 1

    def to_srgb(
        self, radiance: Float[Tensor, "*batch 3"], gains: Float[Tensor, "*#batch 3"] | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Encode radiance, multiplied by the gains, as sRGB.

        Values are not clipped, so that overexposed predictions have gradients.
        """
        radiance = radiance if gains is None else radiance * gains
        return radiance if self is ColourSpace.SRGB else to_srgb(radiance)

    def to_display(
        self, radiance: Float[Tensor, "*batch 3"], gains: Float[Tensor, "*#batch 3"] | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Encode radiance, multiplied by the gains, as sRGB clipped to [0, 1], like a photograph."""
        return self.to_srgb(radiance, gains).clamp(0, 1)

    def to_radiance(self, rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Decode sRGB values, which may lie outside [0, 1], the inverse of `to_srgb` without gains."""
        return rgb if self is ColourSpace.SRGB else to_linear(rgb)

    def to_linear(self, radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Convert radiance of this colour space to linear radiance."""
        return to_linear(radiance.clamp(min=0)) if self is ColourSpace.SRGB else radiance

    def prediction_and_target(
        self, radiance: Float[Tensor, "*batch 3"], rgb: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """Return the values of a prediction and a photograph for a loss: sRGB, or scaled radiance for `HDR`.

        Both are equal where prediction and photograph are saturated, because the photograph gives only a lower bound.

        The squared error of `HDR` is the loss of RawNeRF (Mildenhall et al., NeRF in the Dark, CVPR 2022, section 4.1):
        (c - y)^2 / (sg(c) + e)^2 for radiance c, photograph y and the stop-gradient sg. It linearizes the error of
        log(c + e), so that bright highlights do not dominate, and its minimum is the mean of y, unlike that of an error
        of encoded values. The factor and e give the slope of sRGB at black and at white, so that weights of losses keep
        their meaning; RawNeRF has the factor 1 and e = 0.001, for photographs in near-darkness.

        Args:
            radiance: predicted radiance in this colour space.
            rgb: values of the photograph, sRGB, which lie outside [0, 1] only in photographs in linear light.

        Returns:
            Prediction and target. The prediction is not clipped.
        """
        prediction = self.to_srgb(radiance)
        if self is ColourSpace.SRGB:
            return prediction, rgb
        target = clipped_alike(rgb, prediction)
        if self is ColourSpace.LINEAR:
            return prediction, target
        scale = _LOG_SLOPE / (radiance.detach().clamp(min=0) + _LOG_OFFSET)
        return scale * radiance, scale * to_linear(target)
