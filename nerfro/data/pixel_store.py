"""The colours of all training pixels, in the 8 or 16 bits of their files."""

from __future__ import annotations

import hashlib
import mmap

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.data.pictures import Pictures
from nerfro.files.mapped import mapped_array

# Bytes of pictures beyond which they are mapped from a file instead of held in memory.
_MAPPED_FROM = 2**30


class PixelStore:
    """Colours by the number of their pixel, view * H * W + row * W + column; numbers only when they are drawn."""

    def __init__(self, images: Pictures | Float[Tensor, "V H W 3"]) -> None:
        self._resident = None if isinstance(images, Tensor) else _resident(images)
        levels = images if isinstance(images, Tensor) else torch.from_numpy(self._resident)
        self._levels = levels.view(-1, 3)

    def to(self, device: torch.device | str) -> PixelStore:
        moved = object.__new__(PixelStore)
        moved._resident, moved._levels = self._resident, self._levels.to(device)
        return moved

    def forget(self) -> None:
        """Give back the memory of what is mapped from a file; it is read again when it is asked for."""
        if isinstance(self._resident, np.memmap) and hasattr(mmap, "MADV_DONTNEED"):
            self._resident._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]

    def __getitem__(self, pixels: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        levels = self._levels.index_select(0, pixels)
        if levels.dtype == torch.uint8:
            return levels.float() / 255
        # PyTorch does little with uint16, so that levels above 32767 are here as negative ones.
        return (levels.int() & 65535).float() / 65535 if levels.dtype == torch.int16 else levels


def _resident(images: Pictures) -> np.ndarray:
    """All levels, of 16 bits as int16."""
    shape = (len(images), *images.shape, 3)
    if np.prod(shape) * images.dtype.itemsize < _MAPPED_FROM:
        stack = np.empty(shape, images.dtype)
        for view, levels in enumerate(images.all_levels()):
            stack[view] = levels
    else:
        stack = mapped_array(_key(images), shape, images.dtype, images.all_levels)
    return stack.view(np.int16) if images.dtype == np.uint16 else stack


def _key(images: Pictures) -> str:
    digest = hashlib.sha256(f"{images.recipe} {images.dtype} {images.downscale} {images.window}".encode())
    for path in images.files:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:32]
