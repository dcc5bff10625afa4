"""Saved state of a long computation, from which an interrupted computation resumes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from nerfro.files.atomic import write_atomically


class Record:
    """State of a computation in a file, which is removed at the end.

    Args:
        path: file of the state; None saves nothing.
        key: identifies the computation; a state with another key is ignored.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path, self._key = path, key

    def read(self) -> dict[str, Any] | None:
        """Read the state of this computation; None if there is no valid one."""
        if self._path is None:
            return None
        try:
            found = torch.load(self._path, weights_only=True)
            return found["state"] if found["key"] == self._key else None
        except Exception:  # torch.load raises nearly anything on a damaged file
            return None

    def write(self, state: dict[str, Any]) -> None:
        """Save a state of plain values and tensors."""
        if self._path is not None:
            content = io.BytesIO()
            torch.save({"key": self._key, "state": state}, content)
            write_atomically(self._path, content.getvalue())

    def remove(self) -> None:
        """Remove the file at the end of the computation."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
