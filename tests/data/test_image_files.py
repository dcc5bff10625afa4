"""Images and masks of every file type, against slow means and hand-written values."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from nerfro.data import image_files
from nerfro.data.image_files import area_mean, downscaled, to_unit
from tests.conftest import refused


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


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("num_channels", [1, 3, 4])
def test_16bit_levels_keep_all_their_bits(num_channels: int, suffix: str, tmp_path: Path):
    picture = np.random.default_rng(0).integers(0, 65536, (9, 7, num_channels), dtype=np.uint16)
    write_16bit(tmp_path / f"image{suffix}", picture)
    assert image_files.read_size(tmp_path / f"image{suffix}") == (7, 9, 16)
    np.testing.assert_array_equal(image_files.read_levels(tmp_path / f"image{suffix}"), picture)


@pytest.mark.parametrize("photometric", ["minisblack", "miniswhite"])
@pytest.mark.parametrize("num_channels", [1, 2])
def test_16bit_grey_tiff_files_may_have_alpha_or_zero_for_white(num_channels: int, photometric: str, tmp_path: Path):
    picture = np.random.default_rng(0).integers(0, 65536, (9, 7, num_channels), dtype=np.uint16)
    stored = picture.copy()
    if photometric == "miniswhite":
        stored[..., 0] = 65535 - picture[..., 0]
    extra = ["unassalpha"] if num_channels > 1 else None
    tifffile.imwrite(tmp_path / "a.tif", stored.squeeze(), photometric=photometric, extrasamples=extra)
    assert image_files.read_size(tmp_path / "a.tif") == (7, 9, 16)
    np.testing.assert_array_equal(image_files.read_levels(tmp_path / "a.tif"), picture)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colours_of_tiff_files_that_are_multiplied_by_alpha_are_divided_by_it(dtype: type, tmp_path: Path):
    random, most = np.random.default_rng(0), np.iinfo(dtype).max
    picture = random.integers(0, most, (9, 7, 4), dtype=dtype, endpoint=True)
    picture[..., 3] = random.integers(most // 2, most, (9, 7), dtype=dtype, endpoint=True)
    picture[0, 0] = 0
    stored = picture.copy()
    stored[..., :3] = np.rint(picture[..., :3] * (picture[..., 3:] / most))
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=["assocalpha"])
    found = image_files.read_levels(tmp_path / "a.tif").astype(int)
    assert np.abs(found - picture).max() <= 2  # levels, of the rounding of the product


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


# Object 1 is left and object 2 right, on a background; both are larger than an outline.
LABELS = np.kron(np.array([[0, 0, 0, 0], [0, 1, 2, 0], [0, 0, 0, 0]], np.uint8), np.ones((6, 6), np.uint8))
SEGMENTER = [0, 0, 0, 128, 0, 0, 0, 128, 0]  # black, dark red, dark green


def palette_image(labels: np.ndarray, palette: list[int]) -> Image.Image:
    image = Image.fromarray(labels)
    image.putpalette(palette)
    return image


def test_masks_of_labels_mark_every_object(tmp_path: Path):
    colours = np.array(SEGMENTER, np.uint8).reshape(3, 3)[LABELS]
    alpha = np.dstack([np.full((*LABELS.shape, 3), 200, np.uint8), 255 * (LABELS > 0).astype(np.uint8)])
    images = {
        "palette": palette_image(LABELS, SEGMENTER),
        "palette with a white background": palette_image(LABELS, [255, 255, 255, *SEGMENTER[3:]]),
        "palette with black in another place": palette_image(
            np.array([2, 0, 1], np.uint8)[LABELS], [128, 0, 0, 0, 128, 0, 0, 0, 0]
        ),
        "colours": Image.fromarray(colours),
        "grey 0, 1, 2": Image.fromarray(LABELS),
        "grey 0, 38, 75": Image.fromarray(np.array([0, 38, 75], np.uint8)[LABELS]),
        "grey 0, 128, 255": Image.fromarray(np.array([0, 128, 255], np.uint8)[LABELS]),
        "one dark level": Image.fromarray(128 * (LABELS > 0).astype(np.uint8)),
        "16 bits": Image.fromarray(LABELS.astype(np.uint16)),
        "alpha": Image.fromarray(alpha),
    }
    for name, image in images.items():
        image.save(tmp_path / "mask.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), LABELS > 0, err_msg=name)


def test_chosen_labels_are_indices_or_grey_levels_of_the_file(tmp_path: Path):
    for bits, image in (
        (8, palette_image(LABELS, SEGMENTER)),
        (8, Image.fromarray(LABELS)),
        (2, palette_image(LABELS, SEGMENTER)),
    ):
        image.save(tmp_path / "mask.png", bits=bits)
        for labels in ([2], [1, 2], [0], [3]):
            expected = np.isin(LABELS, labels)
            np.testing.assert_array_equal(to_unit(image_files.read_mask(tmp_path / "mask.png", labels)), expected)
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "mask.png")
    refused("has colours, which have no labels", image_files.read_mask, tmp_path / "mask.png", [1])


def test_coverage_along_the_outline_is_preserved(tmp_path: Path):
    rows, columns = np.mgrid[:40, :40] / 40 - 0.5
    parts = np.stack([np.hypot(rows + dr, columns + dc) < 0.3 for dr in (0, 0.0125) for dc in (0, 0.0125)])
    coverage = np.rint(255 * parts.mean(0)).astype(np.uint8)  # five levels only
    assert 4 <= len(np.unique(coverage)) <= 5
    for name, image in {
        "grey": Image.fromarray(coverage),
        "palette": palette_image(coverage, [i // 3 for i in range(768)]),
    }.items():
        image.save(tmp_path / f"{name}.png")
        np.testing.assert_allclose(read_mask(tmp_path / f"{name}.png"), coverage / 255, atol=1e-6)
    Image.fromarray(np.where(coverage > 0, 235, 16).astype(np.uint8)).save(tmp_path / "no_zero.png")
    assert len(np.unique(read_mask(tmp_path / "no_zero.png"))) == 2


def test_empty_masks_and_masks_of_one_label_are_read(save):
    assert (read_mask(save(np.zeros((4, 4), np.uint8))) == 0).all()
    assert (read_mask(save(np.ones((4, 4), np.uint8))) == 1).all()
    np.testing.assert_array_equal(read_mask(save(np.array([[0, 1, 1, 0]], np.uint8))), [[0, 1, 1, 0]])
    lossless = save(LABELS).with_suffix(".webp")
    Image.fromarray(120 * LABELS.clip(max=1)).save(lossless, lossless=True)
    np.testing.assert_array_equal(read_mask(lossless), LABELS > 0)


@pytest.mark.parametrize("factor", [1, 1.2, 1.7, 2, 2.5, 3, 4, 5, 6, 11.9, 40])
def test_downscaling_by_any_factor_averages_the_pixel_area(factor):
    values = np.random.default_rng(0).random((12, 18, 3), dtype=np.float32)
    small = area_mean(values, downscaled((12, 18), factor))
    height, width = small.shape[:2]
    assert height == max(1, round(12 / factor))
    # Each pixel in so many parts that both sizes' edges lie between them: blocks of whole parts.
    parts = np.kron(values.astype(np.float64), np.ones((height, width, 1)))
    expected = parts.reshape(height, 12, width, 18, 3).mean((1, 3))
    np.testing.assert_allclose(small, expected, atol=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_truncated_16bit_image_is_named(suffix: str, tmp_path: Path):
    path = tmp_path / f"image{suffix}"
    write_16bit(path, np.random.default_rng(0).integers(0, 65536, (20, 20, 3), dtype=np.uint16))
    path.write_bytes(path.read_bytes()[:-300])
    refused(rf"image\{suffix} cannot be read", read_rgb, path, "drop")


def test_flipped_bit_in_an_8bit_image_is_detected(save):
    path = save(levels(20, 20, 3))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)
    refused(r"image\.png cannot be read", read_rgb, path, "drop")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_rotated_orientation_tag_is_refused(orientation: int, suffix: str, tmp_path: Path) -> None:
    path, exif = tmp_path / f"a{suffix}", Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (6, 4)).save(path, exif=exif)
    if orientation == 1:
        assert image_files.read_size(path)[:2] == (6, 4)
        assert image_files.read_levels(path).shape == (4, 6, 3)
        return
    for read in (image_files.read_size, image_files.read_levels):
        refused(rf"EXIF orientation {orientation}; rotate its pixels", read, path)
