"""Structural similarity (SSIM) and its form over several scales (MS-SSIM)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.regions import mean_over

WINDOW = 11  # pixels: a Gaussian of sigma 1.5, cut off at 3.5 sigma
SIGMA = 1.5  # pixels
STABILISERS = (0.01**2, 0.03**2)  # C1 and C2 for values in [0, 1]
SCALE_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # finest first
MS_SSIM_MIN_SIZE = (WINDOW - 1) * 2 ** (len(SCALE_EXPONENTS) - 1) + 1  # pixels, for a window on the coarsest scale


def ssim_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """Structural similarity in [-1, 1] at each pixel and channel whose whole window lies inside the picture.

    Gaussian window of 11 pixels and sigma 1.5, weighted (not unbiased) covariances, K = (0.01, 0.03), sRGB in [0, 1];
    in double precision, since variances are differences of nearly equal numbers. Source: Wang et al., "Image quality
    assessment: from error visibility to structural similarity", 2004, Eqn. 13 to 16.
    """
    if min(prediction.shape[:2]) < WINDOW:
        raise NerfroError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, got {list(prediction.shape[:2])}")
    luminance, contrast = _luminance_and_contrast(_channels(prediction), _channels(target))
    return (luminance * contrast).permute(1, 2, 0)


def ssim(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Structural similarity, the mean of `ssim_map` over channels, and over all pixels or those of a mask.

    NaN if no pixel of the mask has its whole window inside the picture.
    """
    return mean_over(ssim_map(prediction, target).mean(-1), _with_whole_window(inside))


def ms_ssim(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Structural similarity over five scales, each half as fine as the one before.

    prod_j cs_j^b_j, with the mean of contrast and structure on the scales 1 to 4 and of the whole similarity on the
    coarsest; negative means count as 0. By channel, then the mean over channels, as pytorch-msssim and TensorFlow do
    it. Scales are means over 2 x 2 pixels; an odd last row or column is a mean over what is there. Of a mask those
    pixels count on coarser scales that are covered by half or more; NaN if on some scale none has its whole window
    inside the picture. Source: Wang et al., "Multiscale structural similarity for image quality assessment", 2003, Eqn.
    7.
    """
    if min(prediction.shape[:2]) < MS_SSIM_MIN_SIZE:
        raise NerfroError(
            f"MS-SSIM needs at least {MS_SSIM_MIN_SIZE} x {MS_SSIM_MIN_SIZE} pixels for its five scales, "
            f"got {list(prediction.shape[:2])}; take SSIM"
        )
    x, y = _channels(prediction), _channels(target)
    weights = None if inside is None else inside.double()[None]
    product = torch.ones(3, dtype=torch.float64, device=x.device)
    for scale, exponent in enumerate(SCALE_EXPONENTS):
        if scale > 0:
            x, y = _halve(x), _halve(y)
            weights = None if weights is None else _halve(weights)
        luminance, contrast = _luminance_and_contrast(x, y)
        similarity = luminance * contrast if scale == len(SCALE_EXPONENTS) - 1 else contrast
        counted = None if weights is None else _with_whole_window(weights[0] >= 0.5)
        means = torch.stack([mean_over(channel, counted) for channel in similarity])
        product = product * means.clamp(min=0) ** exponent
    return product.mean()


def _luminance_and_contrast(
    x: Float[Tensor, "C H W"], y: Float[Tensor, "C H W"]
) -> tuple[Float[Tensor, "C H-10 W-10"], Float[Tensor, "C H-10 W-10"]]:
    """The two factors of SSIM: agreement of local means, and of local contrast and structure."""
    c1, c2 = STABILISERS
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = _window_means(torch.stack([x, y, x * x, y * y, x * y]))
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    variances = (mean_xx - mean_x**2 + mean_yy - mean_y**2).clamp(min=0)
    contrast = (2 * (mean_xy - mean_x * mean_y) + c2) / (variances + c2)
    return luminance, contrast


def _window_means(values: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H-10 W-10"]:
    """Gaussian-weighted means around each pixel whose window lies inside; columns first, then rows."""
    offsets = torch.arange(WINDOW, dtype=values.dtype) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    # Sums of shifted pictures are ten times faster than torch's convolution, which is slow in double precision.
    for axis in (-1, -2):
        length = values.shape[axis] - WINDOW + 1
        means = torch.zeros_like(values.narrow(axis, 0, length))
        for shift, weight in enumerate((weights / weights.sum()).tolist()):
            means = means.add_(values.narrow(axis, shift, length), alpha=weight)
        values = means
    return values


def _with_whole_window(inside: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H-10 W-10"] | None:
    border = WINDOW // 2
    return None if inside is None else inside[border:-border, border:-border]


def _halve(values: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
    return F.avg_pool2d(values, 2, ceil_mode=True)


def _channels(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "3 H W"]:
    return picture.double().permute(2, 0, 1)
