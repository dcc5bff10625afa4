"""A large array that is made once, kept in the cache folder, and mapped into memory."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from nerfro.files.atomic import atomic_file
from nerfro.files.cache import cache_dir

# Bytes of all mapped arrays together; those that have not been used for longest go first.
LIMIT = 32 * 2**30
_PREFIX = "mapped_"
_ABANDONED_SECONDS = 86400.0


def mapped_array(
    key: str, shape: tuple[int, ...], dtype: np.dtype, parts: Callable[[], Iterable[np.ndarray]]
) -> np.ndarray:
    """An array of which only what is looked at is in memory; what is written to it stays in this process.

    Args:
        key: hash of all that the array depends on.
        shape, dtype: of the array.
        parts: makes its parts in order, along the first axis; called where there is no file yet.
    """
    path = cache_dir() / f"{_PREFIX}{key}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):  # not there, or damaged
        array = np.load(path, mmap_mode="c", allow_pickle=False)
        if array.shape == shape and array.dtype == dtype:
            os.utime(path)
            return array
    with atomic_file(path, "free some space, or set NERFRO_CACHE to another folder") as file:
        _make_room(path.parent, int(np.prod(shape)) * dtype.itemsize)
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for part in parts():
            file.write(np.ascontiguousarray(part).data)
    return np.load(path, mmap_mode="c", allow_pickle=False)


def _make_room(folder: Path, num_bytes: int) -> None:
    """Remove what killed processes left, and what was used longest ago while there would be more than the limit.

    A process that has a file mapped keeps it after it is removed.
    """
    for partial in folder.glob(f"*{_PREFIX}*.partial"):
        if time.time() - partial.stat().st_mtime > _ABANDONED_SECONDS:
            partial.unlink(missing_ok=True)
    files = sorted(folder.glob(f"{_PREFIX}*.npy"), key=lambda path: path.stat().st_mtime)
    total = num_bytes + sum(path.stat().st_size for path in files)
    for path in files:
        if total > LIMIT:
            total -= path.stat().st_size
            path.unlink(missing_ok=True)
