"""Images and masks of every kind, against slow means and hand-written values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from nerfro.data import image_files
from nerfro.data.image_files import _coverage, area_mean, downscaled, to_unit
from nerfro.errors import NerfroError


@pytest.fixture
def save(tmp_path: Path):
    def write(levels: np.ndarray, name: str = "image.png", mode: str | None = None) -> Path:
        image = Image.fromarray(levels)
        (image.convert(mode) if mode else image).save(tmp_path / name)
        return tmp_path / name

    return write


def read_rgb(path: Path, alpha: image_files.Alpha) -> np.ndarray:
    return to_unit(image_files.read_rgb(path, alpha))


def read_mask(path: Path) -> np.ndarray:
    return to_unit(image_files.read_mask(path))


def write_16bit(path: Path, picture: np.ndarray) -> None:
    """Write a file by other programs than the one that reads it."""
    if path.suffix == ".tif":
        tifffile.imwrite(path, picture.squeeze(), photometric="rgb" if picture.shape[-1] > 1 else "minisblack")
    else:
        cv2.imwrite(str(path), picture[..., [2, 1, 0, 3][: picture.shape[-1]]] if picture.shape[-1] > 1 else picture)


def levels(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_8bit_levels_are_divided_by_255(save):
    picture = levels(5, 4, 3)
    rgb = read_rgb(save(picture), "drop")
    assert rgb.dtype == np.float32
    np.testing.assert_allclose(rgb, picture / 255, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("num_channels", [1, 3, 4])
def test_16bit_levels_keep_all_their_bits(num_channels: int, suffix: str, tmp_path: Path):
    picture = np.random.default_rng(0).integers(0, 65536, (9, 7, num_channels), dtype=np.uint16)
    write_16bit(tmp_path / f"image{suffix}", picture)
    assert image_files.read_size(tmp_path / f"image{suffix}") == (7, 9, 16)
    np.testing.assert_array_equal(image_files.read_levels(tmp_path / f"image{suffix}"), picture)


@pytest.mark.parametrize("mode", ["L", "P", "1"])
def test_grey_palette_and_bilevel_images_become_rgb(save, mode):
    grey = np.where(levels(5, 4) > 127, 255, 0).astype(np.uint8)
    expected = np.repeat(grey[..., None] / 255, 3, -1)
    np.testing.assert_allclose(read_rgb(save(grey, mode=mode), "drop"), expected)


def test_transparency_is_dropped_or_composited(save):
    picture = levels(5, 4, 4)
    path = save(picture)
    rgb, opacity = picture[..., :3] / 255, picture[..., 3:] / 255
    np.testing.assert_allclose(read_rgb(path, "drop"), rgb, rtol=1e-6)
    np.testing.assert_allclose(read_rgb(path, "white"), rgb * opacity + 1 - opacity, atol=0.51 / 65535)
    np.testing.assert_allclose(read_rgb(path, "black"), rgb * opacity, atol=0.51 / 65535)


def test_transparent_grey_is_composited(save):
    picture = levels(5, 4, 2)
    grey, opacity = picture[..., :1] / 255, picture[..., 1:] / 255
    expected = np.repeat(grey * opacity + 1 - opacity, 3, -1)
    np.testing.assert_allclose(read_rgb(save(picture), "white"), expected, atol=0.51 / 65535)


def test_mask_is_the_share_of_the_pixel(save):
    mask = np.array([[0, 51, 255]], np.uint8)
    np.testing.assert_allclose(read_mask(save(mask)), [[0, 0.2, 1]], atol=1e-6)


def test_mask_of_labels_and_coloured_mask_mark_the_object(save):
    labels = np.array([[0, 1, 1, 0]], np.uint8)
    np.testing.assert_array_equal(read_mask(save(labels)), [[0, 1, 1, 0]])
    coloured = np.zeros((1, 4, 3), np.uint8)
    coloured[0, 1:3, 2] = 255
    np.testing.assert_array_equal(read_mask(save(coloured)), [[0, 1, 1, 0]])
    assert (read_mask(save(np.zeros((2, 2), np.uint8))) == 0).all()


@pytest.mark.parametrize("factor", [1, 2, 3, 6])
def test_downscaling_is_the_mean_over_each_block(factor):
    values = np.random.default_rng(0).random((12, 18, 3), dtype=np.float32)
    small = area_mean(values, downscaled((12, 18), factor))
    assert small.shape == (12 // factor, 18 // factor, 3)
    for i in range(small.shape[0]):
        for j in range(small.shape[1]):
            block = values[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor].astype(np.float64)
            np.testing.assert_allclose(small[i, j], block.reshape(-1, 3).mean(0), rtol=1e-6)


@pytest.mark.parametrize("factor", [1.2, 1.7, 2.5, 4, 5, 11.9, 40])
def test_any_factor_is_the_mean_over_the_area_of_a_pixel(factor):
    values = np.random.default_rng(0).random((12, 18, 3), dtype=np.float32)
    small = area_mean(values, downscaled((12, 18), factor))
    height, width = small.shape[:2]
    assert height == max(1, round(12 / factor))
    # Each pixel in so many parts that both sizes' edges lie between them: blocks of whole parts.
    parts = np.kron(values.astype(np.float64), np.ones((height, width, 1)))
    expected = parts.reshape(height, 12, width, 18, 3).mean((1, 3))
    np.testing.assert_allclose(small, expected, atol=1e-6)


def test_factors_beside_a_whole_one_lead_to_it():
    values = np.random.default_rng(0).random((12, 18), dtype=np.float32)
    np.testing.assert_allclose(_mixed(values, (6, 9)), area_mean(values, (6, 9)), atol=1e-6)


def _mixed(values, size):
    """By the sparse product alone."""
    return (_coverage(values.shape[0], size[0]) @ values) @ _coverage(values.shape[1], size[1]).T


@pytest.mark.parametrize("kept", [0, 20, 60, 150])
def test_truncated_or_corrupt_image_is_named(save, kept):
    path = save(levels(20, 20, 3))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(NerfroError, match=r"image\.png cannot be read"):
        read_rgb(path, "drop")


def test_file_that_is_no_image_is_named(tmp_path: Path):
    (tmp_path / "image.png").write_text("no image")
    with pytest.raises(NerfroError, match=r"image\.png cannot be read \(it is not an image\)"):
        read_rgb(tmp_path / "image.png", "drop")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_truncated_16bit_image_is_named(suffix: str, tmp_path: Path):
    path = tmp_path / f"image{suffix}"
    write_16bit(path, np.random.default_rng(0).integers(0, 65536, (20, 20, 3), dtype=np.uint16))
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(NerfroError, match=rf"image\{suffix} cannot be read") as raised:
        read_rgb(path, "drop")
    assert len(str(raised.value).splitlines()) == 1


def test_tiff_of_floating_point_is_refused(tmp_path: Path):
    tifffile.imwrite(tmp_path / "image.tif", np.zeros((4, 4), np.float32))
    with pytest.raises(NerfroError, match=r"channels are float32; save it with 8 or 16 bits per channel"):
        read_rgb(tmp_path / "image.tif", "drop")


def test_8bit_tiff_is_read(tmp_path: Path):
    picture = levels(5, 4, 3)
    tifffile.imwrite(tmp_path / "image.tif", picture, photometric="rgb")
    np.testing.assert_allclose(read_rgb(tmp_path / "image.tif", "drop"), picture / 255, rtol=1e-6)


def test_flipped_bit_in_an_8bit_image_is_found(save):
    path = save(levels(20, 20, 3))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)
    with pytest.raises(NerfroError, match=r"image\.png cannot be read"):
        read_rgb(path, "drop")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_photograph_that_asks_to_be_turned_is_refused(orientation: int, suffix: str, tmp_path: Path) -> None:
    path, exif = tmp_path / f"a{suffix}", Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (6, 4)).save(path, exif=exif)
    if orientation == 1:
        assert image_files.read_size(path)[:2] == (6, 4)
        assert image_files.read_levels(path).shape == (4, 6, 3)
        return
    for read in (image_files.read_size, image_files.read_levels):
        with pytest.raises(NerfroError, match=rf"EXIF orientation {orientation}; rotate its pixels"):
            read(path)
