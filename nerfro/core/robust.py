"""The Geman-McClure loss, which limits the influence of outliers."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def geman_mcclure(residual: Float[Tensor, "*Q C"], scale: float) -> Float[Tensor, "*Q"]:
    """Compute the Geman-McClure loss r^2 / (r^2 + scale^2): 0 for exact values, 1 for outliers.

    Args:
        residual: residuals of C channels; r is their root mean square.
        scale: residual at which the loss is 1/2 of its maximum.
    """
    square = residual.square().mean(-1)
    return square / (square + scale**2)


def geman_mcclure_weight(residual: Float[Tensor, "*Q C"], scale: float) -> Float[Tensor, "*Q"]:
    """Compute the weights 1 / (1 + r^2 / scale^2)^2 that turn least squares into the Geman-McClure loss.

    Args:
        residual: residuals of C channels; r is their root mean square.
        scale: residual at which the weight is 1/4, and the loss is 1/2 of its maximum.
    """
    return 1 / (1 + (residual / scale).square().mean(-1)).square()
