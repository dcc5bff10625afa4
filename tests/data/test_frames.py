"""Which files are images."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfro.data.frames import list_images
from nerfro.errors import NerfroError


def test_masks_and_hidden_files_are_no_images(tmp_path: Path) -> None:
    for name in ("._a.jpg", ".b.png", "mask_a.png", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.raises(NerfroError, match="holds no image"):
        list_images(tmp_path)
    for name in ("b.PNG", "a.jpg"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a.jpg", "b.PNG"]
