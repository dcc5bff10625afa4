"""Conversion between radiance and the sRGB values of photographs."""

from __future__ import annotations

from enum import Enum

from jaxtyping import Float
from torch import Tensor

from nerfro.core.light import clipped_alike, to_linear, to_srgb


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
