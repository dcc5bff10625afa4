"""Square crops of images, and the crop in which methods differ most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import squared_error_map


@dataclass(frozen=True)
class Crop:
    """A square crop of an image: position of the upper left corner and length of the side, in pixels."""

    top: int
    left: int
    size: int

    def inside(self, height: int, width: int) -> bool:
        """Return whether the crop lies inside an image of the given size."""
        return min(self.top, self.left) >= 0 and self.top + self.size <= height and self.left + self.size <= width

    def of(self, image: Float[Tensor, "H W C"]) -> Float[Tensor, "size size C"]:
        """Crop an image; raises an error if the crop exceeds the image."""
        height, width = image.shape[:2]
        if not self.inside(height, width):
            raise NerfroError(f"{self} exceeds an image of {height} x {width} pixels; choose another crop")
        return image[self.top : self.top + self.size, self.left : self.left + self.size]


def most_different_crop(
    reference: Float[Tensor, "H W 3"],
    predictions: Sequence[Float[Tensor, "H W 3"]],
    size: int,
    apart_from: Sequence[Crop] = (),
) -> Crop:
    """Find the square in which methods differ most: the largest sum of the variances of the squared errors.

    With a single method, the square with the largest error is chosen.

    Args:
        reference: ground truth, sRGB in [0, 1].
        predictions: image of each method, sRGB in [0, 1].
        size: side of the square in pixels.
        apart_from: squares that the result must not overlap.

    Raises:
        NerfroError: there is no prediction, or no space for the square.
    """
    if not predictions or not 0 < size <= min(reference.shape[:2]):
        raise NerfroError(
            f"cannot choose a crop of {size} pixels among {len(predictions)} images of {list(reference.shape[:2])}; "
            "give at least one prediction and a smaller crop"
        )
    errors = torch.stack([squared_error_map(prediction, reference) for prediction in predictions])
    differences = errors.var(0, correction=0) if len(predictions) > 1 else errors[0]
    sums = F.avg_pool2d(differences.double()[None, None], size, stride=1)[0, 0]
    for taken in apart_from:
        rows = slice(max(taken.top - size + 1, 0), taken.top + taken.size)
        sums[rows, max(taken.left - size + 1, 0) : taken.left + taken.size] = -torch.inf
    if sums.isneginf().all():
        raise NerfroError(f"there is no space for another crop of {size} pixels; choose a smaller one")
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return Crop(top, left, size)
