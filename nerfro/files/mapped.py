"""Large arrays that are computed once, stored in the cache folder, and mapped into memory."""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from nerfro.core.paths import cache_dir
from nerfro.files.atomic import atomic_file
from nerfro.files.cache import make_room

_CHECKSUM_BYTES = 4  # after the array
_BLOCK = 2**26  # bytes per step of the checksum


def mapped_array(
    key: str, shape: tuple[int, ...], dtype: np.dtype, parts: Callable[[], Iterable[np.ndarray]]
) -> np.ndarray:
    """Map an array into memory copy-on-write: only accessed pages take memory, and changes stay in this process.

    Args:
        key: hash of all inputs of the array.
        shape, dtype: shape and type of the array.
        parts: computes the parts of the array in order, along the first axis; called if there is no valid file.
    """
    path = cache_dir() / f"mapped_{key}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):  # missing or damaged
        array = np.load(path, mmap_mode="c", allow_pickle=False)
        if array.shape == shape and array.dtype == dtype and _is_whole(array, path):
            os.utime(path)
            return array
    with atomic_file(path, "free some space, or set NERFRO_CACHE to another folder") as file:
        make_room(path.parent, int(np.prod(shape)) * dtype.itemsize)
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        checksum = 0
        for part in parts():
            content = np.ascontiguousarray(part).data.cast("B")
            checksum = zlib.crc32(content, checksum)
            file.write(content)
        file.write(checksum.to_bytes(_CHECKSUM_BYTES, "little"))
    return np.load(path, mmap_mode="c", allow_pickle=False)


def _is_whole(array: np.ndarray, path: Path) -> bool:
    """Check the checksum of a mapped array."""
    content, checksum = array.reshape(-1).view(np.uint8), 0
    for start in range(0, len(content), _BLOCK):
        checksum = zlib.crc32(content[start : start + _BLOCK].data, checksum)
    with path.open("rb") as file:
        file.seek(-_CHECKSUM_BYTES, os.SEEK_END)
        return file.read() == checksum.to_bytes(_CHECKSUM_BYTES, "little")
