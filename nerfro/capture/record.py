"""The state of work that takes minutes, in a file: whoever begins the same work again goes on from there."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from nerfro.files.atomic import write_atomically


class Record:
    """A state that is kept now and then, and removed when the work is done.

    Args:
        path: file; without one nothing is kept.
        key: says which work it is. A record of another key is none.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path, self._key = path, key

    def read(self) -> dict[str, Any] | None:
        """The state, if there is one of this work."""
        if self._path is None:
            return None
        try:
            found = torch.load(self._path, weights_only=True)
            return found["state"] if found["key"] == self._key else None
        except Exception:  # torch.load raises nearly anything on a damaged file
            return None

    def write(self, state: dict[str, Any]) -> None:
        """Keep a state of plain values and tensors."""
        if self._path is not None:
            content = io.BytesIO()
            torch.save({"key": self._key, "state": state}, content)
            write_atomically(self._path, content.getvalue())

    def remove(self) -> None:
        """The work is done."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
