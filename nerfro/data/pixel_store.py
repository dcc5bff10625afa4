"""Colours of all training pixels, stored in 8 or 16 bits per channel; those in linear light in floating point."""

from __future__ import annotations

import mmap

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.data.lazy_images import LazyImages
from nerfro.files.cache import content_hash, file_hash, mapped_array

# Images that need more bytes than this are memory-mapped from a cache file.
_MAPPED_FROM = 2**30


class PixelStore:
    """Colours of the pixels of all views, indexed by view * H * W + row * W + column.

    Levels are converted to floating point when a batch is drawn, which saves three quarters of the memory.
    """

    def __init__(self, images: LazyImages | Float[Tensor, "V H W 3"]) -> None:
        self._array = None if isinstance(images, Tensor) else _load(images)
        levels = images if isinstance(images, Tensor) else torch.from_numpy(self._array)
        self._levels = levels.view(-1, 3)

    def release_memory(self) -> None:
        """Release the memory of a memory-mapped store. The pages are read again on the next access."""
        if isinstance(self._array, np.memmap) and hasattr(mmap, "MADV_DONTNEED"):
            self._array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]

    def __getitem__(self, pixels: Int[Tensor, "Q"]) -> Float[Tensor, "Q 3"]:
        levels = self._levels.index_select(0, pixels)
        if levels.dtype == torch.uint8:
            return levels.float() / 255
        # PyTorch supports few operations on uint16. Therefore levels above 32767 are stored as negative int16.
        return (levels.int() & 65535).float() / 65535 if levels.dtype == torch.int16 else levels


def _load(images: LazyImages) -> np.ndarray:
    """Decode all images; 16-bit levels are returned as int16."""
    shape = (len(images), *images.shape, 3)
    if np.prod(shape) * images.dtype.itemsize < _MAPPED_FROM:
        stack = np.empty(shape, images.dtype)
        for view, levels in enumerate(images.all_levels()):
            stack[view] = levels
    else:
        recipe = f"{images.recipe} {images.dtype} {images.downscale} {images.window}"
        key = content_hash(recipe, *map(file_hash, images.files))
        stack = mapped_array(key, shape, images.dtype, images.all_levels)
    return stack.view(np.int16) if images.dtype == np.uint16 else stack
