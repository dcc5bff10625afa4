"""Images of one size that are decoded on access."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.cameras import Window
from nerfro.core.errors import NerfroError
from nerfro.data.image_files import Levels, downscaled, downscaled_levels, read_size, to_unit

_decoded: dict[Hashable, Levels] | None = None


@contextlib.contextmanager
def decoded_once() -> Iterator[None]:
    """Keep downscaled images in memory, for a program that reads the same photographs several times."""
    global _decoded
    _decoded = {}
    try:
        yield
    finally:
        _decoded = None


@dataclass(frozen=True)
class LazyImages:
    """Image files of one size. `images[i]` or `images[:2]` decodes files and returns values in [0, 1].

    Values of photographs in linear light may be below 0 and above 1, see `encode_photograph`.

    The result has shape [H, W, 3], or [H, W] for masks. Create an instance with `LazyImages.of`.

    Attributes:
        files: one file per image.
        read: function that reads one file; called from several threads.
        size: stored height and width in pixels.
        dtype: float32 if a file is in linear light, uint16 if a file has 16 bits or if reading averages or composites
            levels, otherwise uint8.
        downscale: downscaling factor, 1 or more.
        recipe: text that identifies the conversion by `read`. It is part of the cache key of decoded pixels.
        window: region of the downscaled image that is kept, or None for the whole image.
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
        deep: bool = False,
        recipe: str = "",
    ) -> LazyImages:
        """Read the headers of image files and check that the sizes agree.

        Args:
            files: at least one file.
            read: function that reads the levels [H, W, *C] of one file.
            downscale: downscaling factor, 1 or more.
            deep: whether `read` may convert 8-bit to 16-bit levels.
            recipe: see `LazyImages`.

        Raises:
            NerfroError: a header cannot be read, or the sizes differ.
        """
        width, height, bits = read_size(files[0])
        for path in files[1:]:
            *size, depth = read_size(path)
            if size != [width, height]:
                advice = "all images of a split must have the same size"
                if size == [height, width]:
                    advice = (
                        "one is upright and the other lies: rotate the pixels of one kind by 90 degrees and calibrate "
                        "the cameras again, or take its frames out of the data set"
                    )
                raise NerfroError(
                    f"image {path} has {size[0]}x{size[1]} pixels but {files[0]} has {width}x{height}; {advice}"
                )
            bits = max(bits, depth)
        integer = np.uint16 if deep or bits > 8 or downscale > 1 else np.uint8
        dtype = np.dtype(np.float32 if bits > 16 else integer)
        return cls(files, read, (height, width), dtype, downscale, recipe)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels of `images[i]`."""
        if self.window is not None:
            return self.window.height, self.window.width
        return downscaled(self.size, self.downscale)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int | slice) -> Float[Tensor, "..."]:
        if isinstance(index, slice):
            return torch.stack([self[number] for number in range(len(self))[index]])
        return torch.from_numpy(to_unit(self.levels(index)))

    def __iter__(self) -> Iterator[Float[Tensor, "H W *C"]]:
        return (self[index] for index in range(len(self)))

    def levels(self, index: int) -> Levels:
        """Return one image as levels of type `dtype`."""
        if _decoded is None or not self.recipe:
            return self._decode(index)
        file = self.files[index]
        key = file, file.stat().st_mtime_ns, self.recipe, self.size, self.dtype, self.downscale, self.window
        if key in _decoded:
            return _decoded[key]
        levels = self._decode(index)
        # At most 512 MB are kept, and only images of which at least 128 fit.
        if levels.nbytes * max(len(_decoded), 128) <= 2**29:
            _decoded[key] = levels
        return levels

    def _decode(self, index: int) -> Levels:
        levels = self.read(self.files[index])
        if levels.shape[:2] != self.size:
            raise NerfroError(f"the size of image {self.files[index]} has changed during the run; start it again")
        if self.downscale > 1:
            levels = downscaled_levels(levels, downscaled(self.size, self.downscale))
        if self.dtype == np.float32:
            levels = to_unit(levels)
        elif levels.dtype != self.dtype:
            levels = levels.astype(np.uint16) * 257  # maps 255 to 65535, and therefore keeps every level's fraction
        if self.window is None:
            return levels
        top, left, height, width = self.window
        return levels[top : top + height, left : left + width]

    def all_levels(self) -> Iterator[Levels]:
        """Decode all images in order with several threads, only a few images ahead of the consumer."""
        # A limit of 8 bounds the memory for decoding.
        threads = min(os.cpu_count() or 1, 8)
        # Decoding releases the global interpreter lock, so threads suffice.
        with ThreadPoolExecutor(threads) as pool:
            ahead: deque[Future[Levels]] = deque()
            for index in range(len(self)):
                ahead.append(pool.submit(self.levels, index))
                if len(ahead) > threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def select(self, views: Sequence[int]) -> LazyImages:
        """Return the images with the given indices, in this order."""
        return replace(self, files=[self.files[view] for view in views])

    def joined(self, other: LazyImages) -> LazyImages:
        """Append images of the same size; each file is read as before."""
        others = frozenset(other.files)

        def read(path: Path) -> Levels:
            return other.read(path) if path in others else self.read(path)

        dtype = np.promote_types(self.dtype, other.dtype)
        recipe = self.recipe if self.recipe == other.recipe else ""
        return replace(self, files=[*self.files, *other.files], read=read, dtype=dtype, recipe=recipe)

    def cut(self, window: Window) -> LazyImages:
        """Restrict every image to a window."""
        return replace(self, window=window)
