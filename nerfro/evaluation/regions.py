"""Where a picture is scored: on the object's pixels, and on the rectangle around them."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.errors import NerfroError

COVERED = 0.5  # a pixel belongs to the object if at least this share of it is covered
DILATION = 35  # pixels; side of the box by which the paper's authors dilate masks before they cut the rectangle out


def object_pixels(coverage: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """The pixels of the object, from the share of each pixel that it covers (`Views.masks`)."""
    return coverage >= COVERED


def crop_rectangle(inside: Bool[Tensor, "H W"], dilation: int = DILATION) -> tuple[slice, slice]:
    """Rows and columns of the dilated mask's bounding rectangle, the region of the paper's numbers on real scenes.

    Everything in the rectangle counts, object or not. Dilating by a centred box of odd side d moves each side of the
    bounding rectangle by (d - 1) / 2 pixels, as far as the picture goes, so that nothing needs to be dilated.
    """
    if dilation < 1 or dilation % 2 == 0:
        raise NerfroError(f"dilation={dilation} has no centre; take an odd number of pixels, 1 for none")
    if not inside.any():
        raise NerfroError("the mask is empty: there is no object pixel to crop around; score the full image only")
    margin = dilation // 2
    seen = [inside.any(1 - axis).nonzero() for axis in (0, 1)]
    first, last = [max(int(i.min()) - margin, 0) for i in seen], [int(i.max()) + margin + 1 for i in seen]
    return slice(first[0], min(last[0], inside.shape[0])), slice(first[1], min(last[1], inside.shape[1]))


def mean_over(values: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean over the pixels of a mask, or over all if there is none; NaN for an empty mask."""
    return values.mean() if inside is None else values[inside].mean()
