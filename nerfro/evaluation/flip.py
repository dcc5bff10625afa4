"""FLIP: how much a viewer who flips between two pictures sees of their difference.

The values are those of the authors' package flip-evaluator, for displays of low dynamic range (LDR), seen as it takes
by default: 67 pixels in a degree of the field of view, a display 0.7 m wide with 3840 pixels from 0.7 m away. Source:
Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
"""

from __future__ import annotations

import flip_evaluator
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.evaluation.regions import mean_over


def flip_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Visible difference at each pixel of sRGB in [0, 1]: values in [0, 1], float32; 0 where nothing is seen."""
    pictures = [image.detach().cpu().float().contiguous().numpy() for image in (target, prediction)]
    errors, _, _ = flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0]).to(prediction.device)


def flip(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """The mean of `flip_map` over all pixels, or those of a mask; NaN for an empty mask."""
    return mean_over(flip_map(prediction, target), inside)
