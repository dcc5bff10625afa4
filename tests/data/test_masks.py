"""Where silhouettes are looked for, and what they are read as."""

import json
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.data.formats.transforms import BlenderData
from nerfro.data.masks import find_mask, find_masks, with_other_splits
from nerfro.data.transforms import existing_image
from tests.conftest import refused


def _touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        ("train/r_0.png", "train/mask_r_0.png"),
        ("train/r_0.png", "masks/train/r_0.png"),
        ("images/a.jpg", "masks/a.png"),
        ("images/a.jpg", "masks/a.jpg.png"),
        ("images/left/a.jpg", "masks/left/a.png"),
        ("a.jpg", "masks/a.png"),
    ],
)
def test_mask_is_found(tmp_path: Path, image: str, mask: str) -> None:
    assert find_mask(tmp_path, tmp_path / image) is None
    assert find_mask(tmp_path, _touch(tmp_path / image)) is None
    expected = _touch(tmp_path / mask)
    assert find_mask(tmp_path, tmp_path / image) == expected


def test_explicit_mask_has_precedence_and_must_exist(tmp_path: Path) -> None:
    image, beside, stated = (_touch(tmp_path / name) for name in ("a.png", "mask_a.png", "other/b.png"))
    assert find_mask(tmp_path, image) == beside
    assert find_mask(tmp_path, image, "other\\b.png") == stated
    refused(r"mask .*no\.png of .*a\.png does not exist", find_mask, tmp_path, image, "no.png")


@pytest.mark.parametrize(("stated", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_with_composed_and_decomposed_letters_are_the_same(stated: str, stored: str, tmp_path: Path) -> None:
    """macOS decomposes letters with accents, and other systems compare names byte by byte."""
    name, other = (unicodedata.normalize(form, "Glas_für_Öl") for form in (stated, stored))
    image = _touch(tmp_path / "images" / f"{other}.png")
    assert existing_image(tmp_path, f"images/{name}.png") == image
    mask = _touch(tmp_path / "masks" / f"{name}.png")
    assert find_mask(tmp_path, image) == mask
    assert find_mask(tmp_path, image, f"masks/{other}.png") == mask


def test_views_of_different_splits_never_share_a_mask(tmp_path: Path) -> None:
    _touch(tmp_path / "masks" / "r_0.png")
    assert find_mask(tmp_path, _touch(tmp_path / "train" / "r_0.png")) is None


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_transparency_of_any_image_is_the_mask_without_mask_files(tmp_path: Path, mode: str) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for path in paths:
        Image.new("RGB", (4, 2)).convert(mode).save(path)
    assert find_masks(paths, [None] * 3, 1, (4, 2)) is None  # opaque throughout: says nothing
    levels = np.full((2, 4, 4), 255, np.uint8)
    levels[0, :2, 3], levels[1, 3, 3] = 0, 51
    Image.fromarray(levels).save(paths[2])
    masks = find_masks(paths, [None] * 3, 2, (4, 2))
    assert masks is not None
    torch.testing.assert_close(torch.stack(list(masks)), torch.tensor([[[1.0, 1.0]], [[1.0, 1.0]], [[0.5, 0.8]]]))


def test_masks_of_all_splits_are_read_by_their_own_kind(tmp_path: Path) -> None:
    # The mask is the transparency of the training images and a file beside the test images.
    mask = np.zeros((4, 6), np.uint8)
    mask[1:3, 2:5] = 255
    opaque, frame = np.full((4, 6, 3), 90, np.uint8), {"transform_matrix": np.eye(4).tolist()}
    for split, image in (("train", np.dstack([opaque, mask])), ("test", opaque)):
        (tmp_path / split).mkdir()
        Image.fromarray(image).save(tmp_path / split / "a.png")
        document = {"camera_angle_x": 0.7, "frames": [frame | {"file_path": f"{split}/a.png"}]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(document))
    Image.fromarray(mask).save(tmp_path / "test" / "mask_a.png")
    source = BlenderData(str(tmp_path))
    for first in ("train", "test"):
        views = with_other_splits(source.load(first), source, first)
        assert views.masks is not None
        np.testing.assert_array_equal(torch.stack(list(views.masks)), [mask / 255] * 2)


def test_images_without_alpha_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("RGB", (4, 2)).save(tmp_path / "a.jpg")
    monkeypatch.setattr("nerfro.data.masks.read_levels", lambda path: pytest.fail("decoded"))
    assert find_masks([tmp_path / "a.jpg"] * 2, [None] * 2, 1, (4, 2)) is None


def test_incomplete_masks_are_reported_and_ignored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = _touch(tmp_path / "a.png")
    assert find_masks([image, image], [None, image], 1, (4, 2)) is None
    assert "1 of 2 images have no mask (a.png)" in capsys.readouterr().out


def test_jpeg_masks_are_read(tmp_path: Path) -> None:
    image, mask = _touch(tmp_path / "images" / "a.JPG"), tmp_path / "masks" / "a.JPG"
    mask.parent.mkdir()
    levels = np.zeros((32, 32), np.uint8)
    levels[8:24, 8:16] = 255
    Image.fromarray(levels).save(mask, "JPEG")
    assert find_mask(tmp_path, image) == mask
    share = find_masks([image], [mask], 1, (32, 32))
    assert share is not None
    np.testing.assert_array_equal(share[0].numpy() > 0.5, levels > 0)
    png = _touch(mask.with_suffix(".png"))
    assert find_mask(tmp_path, image) == png
