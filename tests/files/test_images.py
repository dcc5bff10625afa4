from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.files.images import load_png, round_to_8bit, save_png
from tests.conftest import refused


def test_every_level_survives_a_file(tmp_path: Path) -> None:
    levels = (torch.arange(16 * 16 * 3) % 256).reshape(16, 16, 3)
    save_png(tmp_path / "new" / "picture.png", levels / 255)
    loaded = load_png(tmp_path / "new" / "picture.png")
    assert torch.equal((loaded * 255).round().long(), levels)
    assert torch.equal(loaded, round_to_8bit(loaded))
    with Image.open(tmp_path / "new" / "picture.png") as image:
        assert image.mode == "RGB"
        assert np.array_equal(np.asarray(image), levels)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_diverged_picture_is_refused_and_overwrites_nothing(tmp_path: Path, bad: float) -> None:
    save_png(tmp_path / "picture.png", torch.zeros(4, 4, 3))
    diverged = torch.ones(4, 4, 3)
    diverged[1, 2, 0] = bad
    refused("1 of the image's 48 values", save_png, tmp_path / "picture.png", diverged)
    assert load_png(tmp_path / "picture.png").max() == 0


def test_unreadable_pictures_are_named(tmp_path: Path) -> None:
    refused(r"missing\.png does not exist", load_png, tmp_path / "missing.png")
    Image.new("RGBA", (4, 4)).save(tmp_path / "transparent.png")
    refused("mode RGBA", load_png, tmp_path / "transparent.png")
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(tmp_path / "deep.png")
    refused("mode I;16", load_png, tmp_path / "deep.png")
