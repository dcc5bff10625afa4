"""Data format of the captured scenes of the paper."""

from __future__ import annotations

from typing import Annotated

from nerfro.allowed import Distance, Factor, Range
from nerfro.data.frames import FrameSet, PosedImages
from nerfro.data.image_files import Alpha
from nerfro.data.transforms import find_splits, read_manifest
from nerfro.registry import register


@register("data", "opencv")
class OpenCVData(PosedImages):
    """Read the format of the paper's captured scenes: `transforms_{train,val,test}.json` with one 3x3 camera matrix.

    Poses have OpenCV camera axes. The centre of pixel (column, row) is at (column + 0.5, row + 0.5), as in the code of
    the paper's authors.

    Args:
        root, near, far, downscale, alpha, mask_labels: see `PosedImages`.
        eval_crop: fraction of each side that is kept around the centre, for the images of every split except train.
    """

    def __init__(
        self,
        root: str,
        near: Distance = 0.2,
        far: Distance = 12.0,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        mask_labels: list[int] | None = None,
        eval_crop: Annotated[float, Range(more_than=0, at_most=1)] = 1.0,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha, mask_labels)
        self.eval_crop = eval_crop

    @property
    def splits(self) -> list[str]:
        return list(find_splits(self.root))

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        crop = 1.0 if split == "train" else self.eval_crop
        return FrameSet(manifest.frames, manifest.lenses(), "opencv", crop=crop)
