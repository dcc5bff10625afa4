"""Template: a metric of your own in one file. Its scores are in all tables, in metrics.json, in logs and in reports.

The file is used only if the environment variable `NERFRO_PLUGINS` names its folder, or if you copy it to `plugins/`.
"""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.parts import ImageMetric, register


@register("metric", "mean_absolute_error")
class MeanAbsoluteError(ImageMetric):
    """Mean absolute difference of the sRGB values."""

    title = "MAE"
    better = "lower"
    decimals = 4

    def forward(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
    ) -> Float[Tensor, ""]:
        errors = (prediction - target).abs().mean(-1)
        return errors.mean() if inside is None else errors[inside].mean()
