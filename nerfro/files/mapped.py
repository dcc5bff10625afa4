"""A large array that is made once, kept in the cache folder, and mapped into memory."""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from nerfro.files.atomic import atomic_file
from nerfro.files.cache import cache_dir, make_room

_CHECKSUM_BYTES = 4  # behind the array
_BLOCK = 2**26  # bytes that are summed up at once


def mapped_array(
    key: str, shape: tuple[int, ...], dtype: np.dtype, parts: Callable[[], Iterable[np.ndarray]]
) -> np.ndarray:
    """An array of which only what is looked at is in memory; what is written to it stays in this process.

    Args:
        key: hash of all that the array depends on.
        shape, dtype: of the array.
        parts: makes its parts in order, along the first axis; called where there is no file yet.
    """
    path = cache_dir() / f"mapped_{key}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):  # not there, or damaged
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
    """Whether a mapped array is what was written."""
    content, checksum = array.reshape(-1).view(np.uint8), 0
    for start in range(0, len(content), _BLOCK):
        checksum = zlib.crc32(content[start : start + _BLOCK].data, checksum)
    with path.open("rb") as file:
        file.seek(-_CHECKSUM_BYTES, os.SEEK_END)
        return file.read() == checksum.to_bytes(_CHECKSUM_BYTES, "little")
