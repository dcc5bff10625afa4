"""Conversion between linear radiance, which is additive, and sRGB, the encoding of images (IEC 61966-2-1)."""

from __future__ import annotations

from enum import Enum
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Values = TypeVar("Values", Tensor, np.ndarray)  # of any shape


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


def clipped_alike(target: Float[Tensor, "*batch"], prediction: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Replace saturated targets by the prediction (without gradient) if the prediction is saturated, too.

    The true value of a saturated pixel is unknown and at least 1, so a brighter prediction is not wrong. If only the
    prediction is saturated, the target remains.
    """
    return torch.where((target >= 1) & (prediction > 1), prediction.detach(), target)


def _tensor(values: np.ndarray) -> Tensor:
    # torch does not support negative strides.
    return torch.from_numpy(np.asarray(values, order="C"))


class ColourSpace(Enum):
    """Colour space in which fields and background return radiance, and rays sum radiance."""

    LINEAR = "linear"
    SRGB = "srgb"  # as in the authors' code

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
        """Encode radiance, multiplied by the gains, as sRGB in [0, 1], like a photograph."""
        return self.to_srgb(radiance, gains).clamp(0, 1)

    def to_radiance(self, rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Decode sRGB values in [0, 1], the inverse of `to_srgb` without gains."""
        return rgb if self is ColourSpace.SRGB else to_linear(rgb)

    def to_linear(self, radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Convert radiance of this colour space to linear radiance."""
        return to_linear(radiance.clamp(min=0)) if self is ColourSpace.SRGB else radiance

    def prediction_and_target(
        self,
        radiance: Float[Tensor, "*batch 3"],
        rgb: Float[Tensor, "*batch 3"],
        gains: Float[Tensor, "*#batch 3"] | None = None,
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """Return the sRGB values of a prediction and a photograph for a loss.

        Both are equal where prediction and photograph are saturated, because the photograph gives only a lower bound.

        Args:
            radiance: predicted radiance in this colour space.
            rgb: values of the photograph, sRGB in [0, 1].
            gains: brightness of each photograph relative to the scene, a factor of linear radiance.

        Returns:
            Prediction and target, sRGB. The prediction is not clipped.
        """
        prediction = self.to_srgb(radiance, gains)
        return prediction, rgb if self is ColourSpace.SRGB else clipped_alike(rgb, prediction)
