"""Files of images: of eight bits, and of linear radiance."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.files.images import load_png, read_radiance, round_to_8bit, save_png, write_radiance
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
def test_diverged_image_is_refused_and_overwrites_nothing(tmp_path: Path, bad: float) -> None:
    save_png(tmp_path / "picture.png", torch.zeros(4, 4, 3))
    diverged = torch.ones(4, 4, 3)
    diverged[1, 2, 0] = bad
    refused("1 of the image's 48 values", save_png, tmp_path / "picture.png", diverged)
    assert load_png(tmp_path / "picture.png").max() == 0


def test_unreadable_images_are_named(tmp_path: Path) -> None:
    refused(r"missing\.png does not exist", load_png, tmp_path / "missing.png")
    Image.new("RGBA", (4, 4)).save(tmp_path / "transparent.png")
    refused("mode RGBA", load_png, tmp_path / "transparent.png")
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(tmp_path / "deep.png")
    refused("mode I;16", load_png, tmp_path / "deep.png")


RADIANCE = np.random.default_rng(0).lognormal(0, 3, (5, 300, 3)).astype(np.float32)


def test_openexr_keeps_every_bit(tmp_path: Path) -> None:
    write_radiance(tmp_path / "image.exr", RADIANCE)
    np.testing.assert_array_equal(read_radiance(tmp_path / "image.exr"), RADIANCE)


@pytest.mark.parametrize("width", [4, 300])
def test_radiance_files_keep_eight_bits_without_bias(width: int, tmp_path: Path) -> None:
    """The channels share an exponent: the error is at most 1/256 of the brightest channel, and has a mean of zero."""
    values = RADIANCE[:, :width].copy()
    values[0, 0] = 0
    write_radiance(tmp_path / "image.hdr", values)
    error = (read_radiance(tmp_path / "image.hdr") - values) / np.maximum(values.max(-1, keepdims=True), 1e-30)
    assert np.abs(error).max() <= 1 / 256
    assert np.abs(error).mean() > 1e-4
    assert abs(error.mean()) < 5e-4
    theirs = cv2.imread(str(tmp_path / "image.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_allclose(theirs, values, atol=values.max() / 128)


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.99])
def test_truncated_files_are_refused_in_one_line(kept: float, suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"image{suffix}"
    write_radiance(file, RADIANCE)
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    with pytest.raises(OSError, match=r".") as raised:
        read_radiance(file)
    assert len(str(raised.value).splitlines()) == 1


def test_file_without_colours_is_refused(tmp_path: Path) -> None:
    write_radiance(tmp_path / "depth.exr", RADIANCE[..., :1])
    with pytest.raises(OSError, match="it has the channels Y, but R, G and B are needed"):
        read_radiance(tmp_path / "depth.exr")
