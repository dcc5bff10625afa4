"""Files that are written whole or not at all, and existing ones that are not replaced unasked."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from nerfro.errors import NerfroError
from nerfro.files.owned import PARTIAL, require_held


@contextlib.contextmanager
def atomic_file(path: Path | str, advice: str = "free some space or choose another folder") -> Iterator[IO[bytes]]:
    """Open a file for writing of which a reader sees the old content or the new one, never a part of it.

    What is written goes to a temporary file in the same folder, made if need be, which takes the place of `path` in one
    step at the end. When anything fails (a full disk, a missing permission), what was at `path` before is still there,
    and a NerfroError ends with the advice.
    """
    path = Path(path)
    temporary = None
    require_held(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=PARTIAL)
        with os.fdopen(descriptor, "w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files private to their owner; give this one the permissions of any other new file. The
        # process's umask can only be read by setting it.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise NerfroError(
            f"cannot write {path}: {error.strerror or error}; what was there before is unchanged; {advice}"
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def write_atomically(path: Path | str, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, whole or not at all (see `atomic_file`)."""
    with atomic_file(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


def refuse_existing(files: Iterable[Path], overwrite: bool) -> None:
    """Refuse to replace files, or folders, that are going to be written and exist, unless they may be replaced."""
    taken = [path for path in files if path.exists()]
    if taken and not overwrite:
        raise NerfroError(f"{taken[0]} exists; give another out=... or overwrite=true")
