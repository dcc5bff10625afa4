"""Pictures of one size that stay in their files until one is asked for."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.cameras import Window
from nerfro.data.image_files import Levels, area_mean, downscaled, read_size, to_levels, to_unit
from nerfro.errors import NerfroError

# Files that are decoded at once, and with them the memory that decoding takes.
_MOST_THREADS = 8


@dataclass(frozen=True)
class Pictures:
    """Pictures of one size: `pictures[i]` reads a file and is [H, W, 3] or, of masks, [H, W], in [0, 1].

    Attributes:
        files: a picture each.
        read: reader of one file; threads call it side by side.
        size: height and width in pixels as stored.
        dtype: of the levels: 16 bits where a file has them, or where levels are means.
        downscale: how many times smaller they become, 1 or more.
        recipe: what `read` does with a file, in words that change when it does something else.
        window: the part that is kept, or None for all of it.
    """

    files: Sequence[Path]
    read: Callable[[Path], Levels]
    size: tuple[int, int]
    dtype: np.dtype
    downscale: float = 1
    recipe: str = ""
    window: Window | None = None

    @classmethod
    def of(
        cls,
        files: Sequence[Path],
        read: Callable[[Path], Levels],
        downscale: float = 1,
        expected_size: tuple[int, int] | None = None,
        deep: bool = False,
        recipe: str = "",
    ) -> Pictures:
        """Pictures, at least one, whose headers agree on a size.

        Args:
            expected_size: width and height in pixels as stored, where the data states them.
            deep: whether levels of 8 bits may become others of 16 when they are read.
        """
        width, height, bits = read_size(files[0])
        if expected_size is not None and expected_size != (width, height):
            raise NerfroError(
                f"image {files[0]} has {width}x{height} pixels where {expected_size[0]}x{expected_size[1]} are "
                "expected; restore the right image or correct the transforms file"
            )
        for path in files[1:]:
            *size, depth = read_size(path)
            if size != [width, height]:
                raise NerfroError(
                    f"image {path} has {size[0]}x{size[1]} pixels but {files[0]} has {width}x{height}; "
                    "all images of a split must have one size"
                )
            bits = max(bits, depth)
        dtype = np.dtype(np.uint16 if deep or bits > 8 or downscale > 1 else np.uint8)
        return cls(files, read, (height, width), dtype, downscale, recipe)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels of what `pictures[i]` returns."""
        if self.window is not None:
            return self.window.height, self.window.width
        return downscaled(self.size, self.downscale)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Float[Tensor, "H W *C"]:
        return torch.from_numpy(to_unit(self.levels(index)))

    def __iter__(self) -> Iterator[Float[Tensor, "H W *C"]]:
        return (self[index] for index in range(len(self)))

    def levels(self, index: int) -> Levels:
        """The levels of one picture, of type `dtype`; a file that has changed is refused."""
        levels = self.read(self.files[index])
        if levels.shape[:2] != self.size:
            raise NerfroError(f"image {self.files[index]} has changed since it was looked at; start again")
        if self.downscale > 1:
            levels = to_levels(area_mean(to_unit(levels), downscaled(self.size, self.downscale)))
        if levels.dtype != self.dtype:
            levels = levels.astype(np.uint16) * 257  # 255 becomes 65535, and every level the same share of it
        if self.window is None:
            return levels
        top, left, height, width = self.window
        return levels[top : top + height, left : left + width]

    def all_levels(self) -> Iterator[Levels]:
        """The levels of all pictures in order, decoded side by side, a few ahead of the one that is asked for."""
        threads = min(os.cpu_count() or 1, _MOST_THREADS)
        # Decoding releases the interpreter's lock, so threads suffice.
        with ThreadPoolExecutor(threads) as pool:
            ahead: deque[Future[Levels]] = deque()
            for index in range(len(self)):
                ahead.append(pool.submit(self.levels, index))
                if len(ahead) > threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def select(self, views: Sequence[int]) -> Pictures:
        """Some of the pictures, in the order that is asked for."""
        return replace(self, files=[self.files[view] for view in views])

    def cut(self, window: Window) -> Pictures:
        """The window of each picture."""
        return replace(self, window=window)
