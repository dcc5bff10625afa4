"""Where two pictures differ: error at each pixel, shown in a perceptual colour map with a fixed scale."""

from __future__ import annotations

import matplotlib
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError

# Squared errors from 0 to this value are told apart; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05


def squared_error_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Squared error of each pixel, mean over channels; its mean over the picture is what PSNR measures.

    Args:
        prediction: sRGB in [0, 1].
        target: sRGB in [0, 1].

    Returns:
        Values in [0, 1].

    Raises:
        NerfroError: if the shapes differ.
    """
    if prediction.shape != target.shape:
        raise NerfroError(
            f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
            "both must be of one size"
        )
    return (prediction - target).square().mean(-1)


def magma(values: Float[Tensor, "H W"], limit: float) -> Float[Tensor, "H W 3"]:
    """Colours of matplotlib's magma: black at 0, through purple and orange, to pale yellow at `limit` and above.

    The scale is given and never fitted to the values, so that pictures can be compared.

    Args:
        values: non-negative numbers.
        limit: value of the last colour, positive.

    Returns:
        sRGB in [0, 1], float32.

    Raises:
        NerfroError: if the limit is not positive.
    """
    if not limit > 0:
        raise NerfroError(f"the limit of a colour scale must be positive, got {limit}")
    num_colours = 256
    table = torch.from_numpy(matplotlib.colormaps["magma"](range(num_colours))[:, :3]).float()
    index = (values.detach().cpu().float() / limit * (num_colours - 1)).round().clamp(0, num_colours - 1)
    return table[index.long()]
