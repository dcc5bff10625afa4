"""Image regions for scores: the pixels of the object, and the rectangle around these."""

from __future__ import annotations

from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from nerfro.core.errors import NerfroError


def object_pixels(coverage: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Return the pixels of which the object covers at least half, from the coverage (`Views.masks`)."""
    return coverage >= 0.5


def crop_rectangle(inside: Bool[Tensor, "H W"]) -> tuple[slice, slice]:
    """Return the bounding rectangle of the dilated mask, the region of the paper's scores on real scenes.

    All pixels of the rectangle count. Dilation by a centred box of 35 pixels moves each side of the bounding rectangle
    by 17 pixels, up to the border of the image, so the mask itself is not dilated.

    Args:
        inside: mask of the object, not empty.

    Returns:
        Slices of rows and columns.
    """
    margin = 17
    occupied = [inside.any(1 - axis).nonzero() for axis in (0, 1)]
    first, last = [max(int(i.min()) - margin, 0) for i in occupied], [int(i.max()) + margin + 1 for i in occupied]
    return slice(first[0], min(last[0], inside.shape[0])), slice(first[1], min(last[1], inside.shape[1]))


def require_images(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Shaped[Tensor, "H W"] | None = None
) -> None:
    """Refuse two images, and a mask, that do not fit; a batch of images is not one image.

    Raises:
        NerfroError: the images are not [H, W, 3] of the same size, or the mask is not [H, W].
    """
    if prediction.shape != target.shape or target.ndim != 3 or target.shape[-1] != 3:
        raise NerfroError(
            f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
            "both must have the same size [H, W, 3]"
        )
    if inside is not None and inside.shape != target.shape[:2]:
        raise NerfroError(f"a mask {list(inside.shape)} does not fit an image {list(target.shape)}; give [H, W]")


def mean_over(values: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Average over the pixels of a mask, or over all pixels without a mask; NaN for an empty mask."""
    return values.mean() if inside is None else values[inside].mean()
