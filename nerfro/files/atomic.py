"""Atomic writing of files, protection of existing files, and locks of output folders.

Only one process writes to a folder, and files of other origin are preserved.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

from nerfro.core.errors import NerfroError, first_of
from nerfro.core.paths import refuse_root


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


_LOCK, PARTIAL = ".lock", ".partial"  # lock file, and ending of files that are being written
_locked: dict[Path, int] = {}  # folders that this process has locked, with the inode of each lock file


@contextlib.contextmanager
def lock_folder(folder: Path, option: str) -> Iterator[None]:
    """Lock a folder for this process, and create the folder if needed.

    A process may lock a folder several times. Partial files of killed processes are removed. A folder without new
    files at the end is restored to its earlier state.

    Args:
        folder: folder to lock.
        option: option that names the folder, for messages.

    Raises:
        NerfroError: another process has locked the folder, or the folder is not writable, or is a whole file system.
    """
    refuse_root(folder, option)
    folder = folder.absolute()
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = {path.name for path in folder.iterdir()}
        lock = FileLock(Path(os.path.realpath(folder)) / _LOCK, is_singleton=True)
        lock.acquire(blocking=False)
        _locked[folder] = (folder / _LOCK).stat().st_ino
        if lock.lock_counter == 1:
            _remove_unfinished(folder)
    except Timeout as error:
        raise NerfroError(
            f"another process is writing to {folder}; wait until it has ended, or choose another {option}"
        ) from error
    except (OSError, NotImplementedError) as error:  # NotImplementedError: a file system without locks
        reason = getattr(error, "strerror", None) or error
        raise NerfroError(f"cannot write to {option}={folder}: {reason}; choose another {option}") from error
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            del _locked[folder]
            with contextlib.suppress(OSError):
                if {path.name for path in folder.iterdir()} - before == {_LOCK}:
                    (folder / _LOCK).unlink()
                    for path in created:
                        path.rmdir()
        lock.release()


def require_lock(path: Path) -> None:
    """Raise an error if a folder above `path` is locked by this process, but was removed or replaced."""
    for folder, inode in _locked.items():
        if not path.absolute().is_relative_to(folder):
            continue
        try:
            removed = (folder / _LOCK).stat().st_ino != inode
        except OSError:
            removed = True
        if removed:
            raise NerfroError(f"{folder} was removed or replaced while nerfro was writing to the folder; start again")


def hold(file: IO[bytes]) -> bool:
    """Lock an open file until the file is closed; returns False if another process holds the lock, or without locks."""
    try:
        import fcntl
    except ImportError:  # Windows, which does not remove open files
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_unfinished(folder: Path) -> None:
    """Remove partial files of killed processes."""
    for partial in folder.rglob(f".*.{'[0-9a-f]' * 16}{PARTIAL}"):
        with contextlib.suppress(OSError), open(partial, "r+b") as file:
            if hold(file):
                partial.unlink()


def require_only(folder: Path, allowed: tuple[str, ...], advice: str) -> None:
    """Raise an error if a folder contains other files than `allowed`; hidden files are ignored."""
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    foreign = [name for name in names if name not in allowed]
    if foreign:
        raise NerfroError(f"{folder} already holds {first_of(foreign)}; {advice}")
