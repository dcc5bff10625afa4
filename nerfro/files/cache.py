"""Arrays that are dear to compute, kept on disk under a hash of everything they depend on."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.paths import user_path


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
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise NerfroError(f"{path} {trouble} ({error}); {advice}") from error


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
    if path.is_file():
        try:
            return load_arrays(path)
        except NerfroError:
            path.unlink(missing_ok=True)
    arrays = compute()
    with contextlib.suppress(NerfroError):
        save_arrays(path, arrays)
    return arrays
