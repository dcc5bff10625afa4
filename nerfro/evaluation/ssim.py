"""Structural similarity (SSIM) and multiscale structural similarity (MS-SSIM)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.regions import mean_over, require_images

WINDOW = 11  # pixels; Gaussian of sigma 1.5, truncated at 3.5 sigma
SIGMA = 1.5  # pixels
STABILISERS = (0.01**2, 0.03**2)  # C1 and C2 for values in [0, 1]
SCALE_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # finest first
MS_SSIM_MIN_SIZE = (WINDOW - 1) * 2 ** (len(SCALE_EXPONENTS) - 1) + 1  # pixels, for a window on the coarsest scale


def ssim_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """Compute the structural similarity at each pixel and channel whose window lies inside the image.

    The window is a Gaussian of 11 pixels and sigma 1.5. Covariances are weighted (not unbiased), K = (0.01, 0.03).
    Double precision is used because variances are differences of nearly equal numbers.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].

    Returns:
        Similarity in [-1, 1].

    Raises:
        NerfroError: the image is smaller than the window.

    Source:
        Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004, Eqn. 13 to 16.
    """
    require_images(prediction, target)
    if min(prediction.shape[:2]) < WINDOW:
        raise NerfroError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, got {list(prediction.shape[:2])}; use PSNR")
    luminance, contrast = _luminance_and_contrast(_channels(prediction), _channels(target))
    return (luminance * contrast).permute(1, 2, 0)


def ssim(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the structural similarity (SSIM), the mean of `ssim_map`; higher is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        Mean in [-1, 1], without unit; NaN if no pixel of the mask has a window inside the image.
    """
    require_images(prediction, target, inside)
    return mean_over(ssim_map(prediction, target).mean(-1), _with_whole_window(inside))


def ms_ssim(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the multiscale structural similarity (MS-SSIM) over five scales; higher is better.

    The result is prod_j cs_j^b_j, where cs_j is the mean of contrast and structure on scales 1 to 4 and the mean SSIM
    on the coarsest scale. Negative means count as 0. The product is computed per channel and then averaged, as in
    pytorch-msssim and TensorFlow. Each scale averages 2 x 2 pixels of the finer one; an odd last row or column averages
    the existing pixels. On coarser scales, a pixel belongs to the mask if at least half of it is covered.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        Similarity in [0, 1], without unit; NaN if on some scale no pixel of the mask has a window inside the image.

    Raises:
        NerfroError: the image is smaller than 161 x 161 pixels.

    Source:
        Wang et al., "Multiscale structural similarity for image quality assessment", 2003, Eqn. 7.
    """
    require_images(prediction, target, inside)
    if min(prediction.shape[:2]) < MS_SSIM_MIN_SIZE:
        raise NerfroError(
            f"MS-SSIM needs at least {MS_SSIM_MIN_SIZE} x {MS_SSIM_MIN_SIZE} pixels for its five scales, "
            f"got {list(prediction.shape[:2])}; use SSIM"
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
    """Compute the two factors of SSIM: similarity of local means, and of local contrast and structure."""
    c1, c2 = STABILISERS
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = _window_means(torch.stack([x, y, x * x, y * y, x * y]))
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    variances = (mean_xx - mean_x**2 + mean_yy - mean_y**2).clamp(min=0)
    contrast = (2 * (mean_xy - mean_x * mean_y) + c2) / (variances + c2)
    return luminance, contrast


def _window_means(values: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H-10 W-10"]:
    """Average with a separable Gaussian window around each pixel whose window lies inside the image."""
    offsets = torch.arange(WINDOW, dtype=values.dtype) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    # Sums of shifted images are ten times faster than convolution in torch, which is slow in double precision.
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


def _channels(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "3 H W"]:
    return image.double().permute(2, 0, 1)
