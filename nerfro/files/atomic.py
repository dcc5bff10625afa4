"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from nerfro.errors import NerfroError


def write_atomically(path: Path | str, content: bytes | str) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part of it.

    The content goes to a temporary file in the same folder, which then takes the place of `path` in one step. When
    anything fails (a full disk, a missing permission), what was at `path` before is still there.

    Args:
        path: the file to write; missing parent folders are made.
        content: bytes, or text that is written as UTF-8.

    Raises:
        NerfroError: if the file cannot be written.
    """
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files private to their owner; give this one the permissions of any other new file.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise NerfroError(
            f"cannot write {path}: {error.strerror or error}; what was there before is unchanged; "
            "free some space or choose another folder"
        ) from error


def refuse_existing(files: Iterable[Path], overwrite: bool) -> None:
    """Check that nothing would be replaced that should stay.

    Args:
        files: that are going to be written, or folders.
        overwrite: whether they may be replaced.

    Raises:
        NerfroError: one exists, and `overwrite` is not set.
    """
    taken = [path for path in files if path.exists()]
    if taken and not overwrite:
        raise NerfroError(f"{taken[0]} exists; give another out=... or overwrite=true")


def _umask() -> int:
    # The process's umask can only be read by setting it.
    mask = os.umask(0)
    os.umask(mask)
    return mask
