"""Atomic writing of files, and protection of existing files."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from nerfro.core.errors import NerfroError
from nerfro.files.folder_lock import PARTIAL, hold, require_lock


@contextlib.contextmanager
def atomic_file(path: Path | str, advice: str = "free some space or choose another folder") -> Iterator[IO[bytes]]:
    """Open a file for atomic writing: readers see the complete old or the complete new content.

    The content is written to a temporary file in the same folder, which replaces `path` at the end. If writing fails,
    for example because the disk is full, the old file is unchanged.

    Args:
        path: file to write; missing folders are created.
        advice: end of the error message.

    Raises:
        NerfroError: the file cannot be written.
    """
    path = Path(path)
    temporary = None
    require_lock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # `tempfile` would make a private file, and the umask, which gives the usual permissions, can only be read by
        # setting it for the whole process. The operating system applies the umask to a file that is opened like this.
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{PARTIAL}")
        with open(temporary, "x+b") as stream:
            hold(stream)
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise NerfroError(
            f"cannot write {path}: {error.strerror or error}; the old file is unchanged; {advice}"
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def write_atomically(path: Path | str, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, atomically (see `atomic_file`)."""
    with atomic_file(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


def refuse_existing(files: Iterable[Path], overwrite: bool) -> None:
    """Check that no file or folder in a list exists, unless overwriting is allowed."""
    taken = [path for path in files if path.exists()]
    if taken and not overwrite:
        raise NerfroError(f"{taken[0]} exists; give another out=... or overwrite=true")


def require_room(folder: Path, needed_bytes: int, option: str) -> None:
    """Raise an error if the disk of a folder is too full; `option` names the folder, for the message."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise NerfroError(
            f"{folder} has {free / 2**20:,.0f} MiB free and this run needs {needed_bytes / 2**20:,.0f}; free some or "
            f"choose another {option}"
        )


def write_json(path: Path | str, content: object, indent: int = 1) -> None:
    """Write a value as JSON atomically."""
    write_atomically(path, json.dumps(content, indent=indent) + "\n")
