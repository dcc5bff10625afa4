"""A folder belongs to one run: one process writes to it, and what the run did not make stays as it is."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from nerfro.errors import NerfroError, first_of

_LOCK, PARTIAL = ".lock", ".partial"  # the second ends the names of files that are being written
_held: dict[Path, int] = {}  # folders of this process, and the inode of each one's lock


@contextlib.contextmanager
def held(folder: Path, option: str) -> Iterator[None]:
    """Hold a folder, made if need be, for this process alone; `option` names it in what the user is told.

    A process may hold a folder several times over. One in which nothing was made is left as it was.

    Raises:
        NerfroError: another process holds it, or it cannot be written to.
    """
    folder = folder.absolute()
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = {path.name for path in folder.iterdir()}
        lock = FileLock(folder / _LOCK, is_singleton=True)
        lock.acquire(blocking=False)
        _held[folder] = (folder / _LOCK).stat().st_ino
    except Timeout as error:
        raise NerfroError(
            f"another process is writing to {folder}; wait until it has ended, or choose another {option}"
        ) from error
    except (OSError, NotImplementedError) as error:  # or a file system that knows no locks
        reason = getattr(error, "strerror", None) or error
        raise NerfroError(f"cannot write to {option}={folder}: {reason}; choose another {option}") from error
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            del _held[folder]
            with contextlib.suppress(OSError):
                if {path.name for path in folder.iterdir()} - before == {_LOCK}:
                    (folder / _LOCK).unlink()
                    for path in new:
                        path.rmdir()
        lock.release()


def is_held(folder: Path) -> bool:
    """Whether another process writes to a folder."""
    if not (folder / _LOCK).exists():
        return False
    try:
        with FileLock(folder / _LOCK, is_singleton=True).acquire(blocking=False):
            return False
    except Timeout:
        return True


def require_held(path: Path) -> None:
    """Refuse to make a file again in a folder that this process holds and somebody has removed or replaced."""
    for folder, inode in _held.items():
        if not path.absolute().is_relative_to(folder):
            continue
        try:
            gone = (folder / _LOCK).stat().st_ino != inode
        except OSError:
            gone = True
        if gone:
            raise NerfroError(f"{folder} was removed while it was written to, so this ends here; start again")


def remove_unfinished(folder: Path) -> None:
    """Remove what killed processes were writing in a folder; what others write in folders that they hold stays."""
    for partial in folder.rglob(f".*{PARTIAL}"):
        below = [path for path in partial.parents if path != folder and path.is_relative_to(folder)]
        if not any(map(is_held, below)):
            partial.unlink(missing_ok=True)


def require_own(folder: Path, allowed: tuple[str, ...], advice: str) -> None:
    """Refuse a folder that holds more than `allowed`; hidden files are never written and do not count."""
    found = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    foreign = [name for name in found if name not in allowed]
    if foreign:
        raise NerfroError(f"{folder} already holds {first_of(foreign)}; {advice}")
