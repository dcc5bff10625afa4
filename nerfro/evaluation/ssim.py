"""Structural similarity (SSIM)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from skimage import metrics
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.evaluation.regions import mean_over, require_images

WINDOW = 11  # pixels; Gaussian of sigma 1.5, truncated at 3.5 sigma


def ssim_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """Compute the structural similarity at each pixel and channel whose window lies inside the image, by scikit-image.

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
    _, similarity = metrics.structural_similarity(
        *(image.detach().cpu().double().numpy() for image in (prediction, target)),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    border = WINDOW // 2
    return torch.from_numpy(similarity[border:-border, border:-border]).to(prediction.device)


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
    border = WINDOW // 2
    inside = None if inside is None else inside[border:-border, border:-border]
    return mean_over(ssim_map(prediction, target).mean(-1), inside)
