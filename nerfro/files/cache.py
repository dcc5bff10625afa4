"""Arrays that are dear to compute, kept on disk under a hash of everything they depend on."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.paths import user_path

# Bytes of all entries together; those that have not been used for longest go first.
LIMIT = 32 * 2**30
_ENTRIES = ("distance_*.npz", "occupancy_*.npz", "mapped_*.npy")
_ABANDONED_SECONDS = 86400.0
_CHECKSUM = "checksum"  # of an entry's arrays, beside them


def cache_dir() -> Path:
    """Where computed grids are kept: `NERFRO_CACHE`, else ~/.cache/nerfro."""
    return Path(os.environ.get("NERFRO_CACHE") or "~/.cache/nerfro").expanduser()


def content_hash(*parts: np.ndarray | str | float | int | bool) -> str:
    """Hexadecimal hash of arrays (type, shape and bytes) and plain values, in order."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(f"{type(part).__name__}:{part!r};".encode())
    return digest.hexdigest()[:32]


def file_hash(path: Path | str) -> str:
    """Hexadecimal hash of a file's content."""
    return hashlib.sha256(user_path(path).read_bytes()).hexdigest()[:32]


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a compressed .npz so that the file is either complete or not there."""
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a .npz of plain arrays without executing pickled code."""
    with _reading(path, "is not a readable .npz of plain arrays", "make it again"), np.load(path) as file:
        return {name: file[name] for name in file.files}


def load_array(path: Path) -> np.ndarray:
    """Read the numbers of a .npy without executing pickled code, in double precision."""
    with _reading(path, "cannot be read", "copy or export it again"):
        array = np.load(path)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise NerfroError(f"{path} is not a .npy of numbers; copy or export it again")
    return array.astype(np.float64)


@contextlib.contextmanager
def _reading(path: Path, trouble: str, advice: str) -> Iterator[None]:
    """Errors within it that tell of a missing or damaged file name it."""
    try:
        yield
    except FileNotFoundError as error:
        raise NerfroError(f"{path} does not exist; check the path") from error
    except Exception as error:  # NumPy and zipfile raise nearly anything on a damaged file
        reason = str(error).strip().split("\n", 1)[0] or type(error).__name__
        raise NerfroError(f"{path} {trouble} ({reason}); {advice}") from error


def cached_arrays(
    key: str, compute: Callable[[], dict[str, np.ndarray]], enabled: bool = True
) -> dict[str, np.ndarray]:
    """Arrays from the cache, or computed and kept there; a damaged or unwritable cache costs time, never the result.

    Args:
        key: name of the entry, with a hash of all that the arrays depend on in it.
        compute: makes the arrays.
        enabled: whether to read and write the cache at all.
    """
    if not enabled:
        return compute()
    path = cache_dir() / f"{key}.npz"
    with contextlib.suppress(NerfroError, OSError):
        arrays = load_arrays(path)
        if str(arrays.pop(_CHECKSUM, "")) == _checksum(arrays):
            os.utime(path)
            return arrays
    arrays = compute()
    with contextlib.suppress(NerfroError, OSError):
        make_room(path.parent, sum(array.nbytes for array in arrays.values()))
        save_arrays(path, {**arrays, _CHECKSUM: np.array(_checksum(arrays))})
    return arrays


def make_room(folder: Path, num_bytes: int) -> None:
    """Remove what killed processes left, and what was used longest ago while there would be more than the limit.

    A process that has a file mapped keeps it after it is removed.
    """
    for pattern in _ENTRIES:
        for partial in folder.glob(f".{pattern}*.partial"):
            if time.time() - partial.stat().st_mtime > _ABANDONED_SECONDS:
                partial.unlink(missing_ok=True)
    files = [path for pattern in _ENTRIES for path in folder.glob(pattern)]
    total = num_bytes + sum(path.stat().st_size for path in files)
    for path in sorted(files, key=lambda path: path.stat().st_mtime):
        if total > LIMIT:
            total -= path.stat().st_size
            path.unlink(missing_ok=True)


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    return content_hash(*(part for name in sorted(arrays) for part in (name, arrays[name])))
