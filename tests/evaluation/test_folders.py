from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfro.core.errors import NerfroError
from nerfro.evaluation.folders import match_folders
from tests.conftest import refused


def write(path: Path, size: tuple[int, int] = (12, 10), channels: int = 3, level: int = 200) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = (size[1], size[0], channels) if channels > 1 else (size[1], size[0])
    Image.fromarray(np.full(shape, level, np.uint8)).save(path)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two views, as predictions and as references."""
    for name in ("a", "b"):
        write(tmp_path / "predictions" / f"{name}.png", level=100)
        write(tmp_path / "references" / f"{name}.bmp")
    return tmp_path / "predictions", tmp_path / "references"


def test_images_are_matched_by_name_in_any_format(folders: tuple[Path, Path]) -> None:
    (folders[0] / "notes.txt").write_text("not a picture")
    (folders[0] / "scores").mkdir()
    pairs = match_folders(*folders, None)
    assert [(pair.name, pair.prediction.name, pair.reference.name) for pair in pairs] == [
        ("a", "a.png", "a.bmp"),
        ("b", "b.png", "b.bmp"),
    ]
    prediction, reference, coverage = pairs[0].load("drop")
    assert prediction.shape == reference.shape == (10, 12, 3)
    assert prediction.unique().tolist() == pytest.approx([100 / 255])
    assert reference.unique().tolist() == pytest.approx([200 / 255])
    assert coverage is None


def test_masks_come_from_the_option_the_references_or_transparency(folders: tuple[Path, Path], tmp_path: Path) -> None:
    predictions, references = folders
    for name in ("a", "b", "c"):  # those of other views do no harm
        write(tmp_path / "masks" / f"{name}.png", channels=1, level=255)
    assert [pair.mask.parent.name for pair in match_folders(predictions, references, tmp_path / "masks")] == [
        "masks",
        "masks",
    ]
    for name in ("a", "b"):
        write(references / f"mask_{name}.png", channels=1, level=255)
    beside = match_folders(predictions, references, None)
    assert [pair.mask.name for pair in beside] == ["mask_a.png", "mask_b.png"]
    assert beside[0].load("drop")[2].unique().tolist() == [1]
    write(references / "mask_a.png", channels=1, level=3)
    assert match_folders(predictions, references, None, [3])[0].load("drop")[2].unique().tolist() == [1]
    assert not match_folders(predictions, references, None, [2])[0].load("drop")[2].any()
    for name in ("a", "b"):
        write(tmp_path / "transparent" / f"{name}.png", channels=4, level=153)
    pair = match_folders(predictions, tmp_path / "transparent", None)[0]
    assert pair.load("drop")[2].unique().tolist() == pytest.approx([153 / 255])
    for alpha, expected in (("drop", 0.6), ("black", 0.36), ("white", 0.76)):
        # Pictures are kept in 16 bits.
        assert pair.load(alpha)[1].unique().tolist() == pytest.approx([expected], abs=1 / 2**16)


def test_images_without_a_partner_are_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    predictions, references = folders
    write(predictions / "c.png")
    refused(r"1 of 3 images have no reference in .*c\.png is the first", match_folders, predictions, references, None)
    for name in ("c", "d", "e"):
        write(references / f"{name}.png")
    refused(r"2 of 5 images have no prediction in .*d\.png is the first", match_folders, predictions, references, None)
    (references / "d.png").unlink()
    (references / "e.png").unlink()
    write(references / "mask_a.png", channels=1)
    refused(r"2 of 3 images have no mask in .*b\.bmp is the first", match_folders, predictions, references, None)
    write(tmp_path / "masks" / "a.png", channels=1)
    refused(r"2 of 3 images have no mask in masks=", match_folders, predictions, references, tmp_path / "masks")


def test_folders_without_images_are_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refused(r"predictions=.*nowhere is not a folder", match_folders, tmp_path / "nowhere", folders[1], None)
    with pytest.raises(NerfroError, match=r"references=.*empty holds no images; allowed are \.png"):
        match_folders(folders[0], tmp_path / "empty", None)
    write(folders[0] / "a.jpg")
    refused(r"a\.jpg and .*a\.png have the same name", match_folders, *folders, None)


def test_damaged_and_unsuitable_files_are_named(folders: tuple[Path, Path]) -> None:
    predictions, references = folders
    write(predictions / "a.png", size=(12, 9))
    with pytest.raises(NerfroError, match=r"a\.png has 12x9 pixels but its reference .*a\.bmp has 12x10"):
        match_folders(*folders, None)[0].load("drop")
    (predictions / "b.png").write_bytes((predictions / "b.png").read_bytes()[:40])
    refused(r"b\.png cannot be read", lambda: match_folders(*folders, None)[1].load("drop"))
    write(predictions / "a.png")
    write(references / "mask_b.png", channels=1, level=255)
    write(references / "mask_a.png", size=(11, 10), channels=1, level=255)
    with pytest.raises(NerfroError, match=r"mask_a\.png has 11x10 pixels but its image has 12x10"):
        match_folders(*folders, None)[0].load("drop")
