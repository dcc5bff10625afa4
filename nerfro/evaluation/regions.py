"""Where a picture is scored: on the object's pixels, and on the rectangle around them."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.errors import NerfroError

COVERED = 0.5  # a pixel belongs to the object if at least this share of it is covered
DILATION = 35  # pixels; side of the box by which the paper's authors dilate masks before they cut the rectangle out


@dataclass(frozen=True)
class Rectangle:
    """A part of a picture: rows from `top` to before `bottom`, columns from `left` to before `right`."""

    top: int
    left: int
    bottom: int
    right: int

    def of(self, picture: Float[Tensor, "H W C"]) -> Float[Tensor, "h w C"]:
        """Cut the rectangle out."""
        return picture[self.top : self.bottom, self.left : self.right]


def object_pixels(coverage: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """The pixels of the object, from the share of each pixel that it covers (`Views.masks`)."""
    return coverage >= COVERED


def crop_rectangle(inside: Bool[Tensor, "H W"], dilation: int = DILATION) -> Rectangle:
    """Bounding rectangle of the dilated mask, the region of the paper's numbers on real scenes.

    Everything in the rectangle counts, object or not. Dilating by a centred box of odd side d moves each side of the
    bounding rectangle by (d - 1) / 2 pixels, as far as the picture goes, so that nothing needs to be dilated.
    """
    if dilation < 1 or dilation % 2 == 0:
        raise NerfroError(f"dilation={dilation} has no centre; take an odd number of pixels, 1 for none")
    if not inside.any():
        raise NerfroError("the mask is empty: there is no object pixel to crop around; score the full image only")
    margin = dilation // 2
    rows, columns = inside.any(1).nonzero()[:, 0], inside.any(0).nonzero()[:, 0]
    return Rectangle(
        max(int(rows[0]) - margin, 0),
        max(int(columns[0]) - margin, 0),
        min(int(rows[-1]) + margin + 1, inside.shape[0]),
        min(int(columns[-1]) + margin + 1, inside.shape[1]),
    )


def mean_over(values: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean over the pixels of a mask, or over all if there is none; NaN for an empty mask."""
    return values.mean() if inside is None else values[inside].mean()
