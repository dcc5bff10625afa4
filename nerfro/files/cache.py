"""Disk cache of expensive arrays, under a hash of all their inputs; large arrays are mapped into memory."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from nerfro.core.errors import NerfroError
from nerfro.core.paths import cache_dir, user_path
from nerfro.files.atomic import atomic_file
from nerfro.files.reading import load_arrays

# Maximum size of all entries in bytes; the least recently used entries are removed first.
LIMIT = 32 * 2**30
_ENTRIES = ("distance_*.npz", "occupancy_*.npz", "mapped_*.npy")
_CHECKSUM = "checksum"  # name of the array that holds the checksum of an entry


def content_hash(*parts: np.ndarray | str | float | int | bool) -> str:
    """Compute a hexadecimal hash of arrays (type, shape and bytes) and plain values, in order."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(f"{type(part).__name__}:{part!r};".encode())
    return digest.hexdigest()[:32]


def file_hash(path: Path | str) -> str:
    """Compute a hexadecimal hash of the content of a file."""
    digest = hashlib.sha256()
    with user_path(path).open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()[:32]


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a compressed .npz file atomically."""
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def cached_arrays(
    key: str, compute: Callable[[], dict[str, np.ndarray]], enabled: bool = True
) -> dict[str, np.ndarray]:
    """Return arrays from the cache, or compute and save them. A damaged or unwritable cache only costs time.

    Args:
        key: name of the entry, which contains a hash of all inputs.
        compute: function that computes the arrays.
        enabled: whether to use the cache.
    """
    if not enabled:
        return compute()
    path = cache_dir() / f"{key}.npz"
    with contextlib.suppress(NerfroError, OSError):
        arrays = load_arrays(path, most_bytes=math.inf)
        if str(arrays.pop(_CHECKSUM, "")) == _checksum(arrays):
            os.utime(path)
            return arrays
    arrays = compute()
    with contextlib.suppress(NerfroError, OSError):
        make_room(path.parent, sum(array.nbytes for array in arrays.values()))
        save_arrays(path, {**arrays, _CHECKSUM: np.array(_checksum(arrays))})
    return arrays


def make_room(folder: Path, num_bytes: int) -> None:
    """Remove partial files of killed processes, and the least recently used entries above the size limit.

    Other processes may remove entries at the same time. A process that has mapped an entry into memory keeps the data.
    """
    for pattern in _ENTRIES:
        for partial, status in _statuses(folder.glob(f".{pattern}*.partial")):
            # A partial file that is a day old is abandoned.
            if time.time() - status.st_mtime > 86400.0:
                partial.unlink(missing_ok=True)
    entries = _statuses(path for pattern in _ENTRIES for path in folder.glob(pattern))
    total = num_bytes + sum(status.st_size for _, status in entries)
    for path, status in sorted(entries, key=lambda entry: entry[1].st_mtime):
        if total > LIMIT:
            total -= status.st_size
            path.unlink(missing_ok=True)


def _statuses(paths: Iterable[Path]) -> list[tuple[Path, os.stat_result]]:
    """Query the status of files; files that have just been removed are left out."""
    statuses = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            statuses.append((path, path.stat()))
    return statuses


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    return content_hash(*(part for name in sorted(arrays) for part in (name, arrays[name])))


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
