"""Properties that all data formats share."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.data.formats.transforms import BlenderData
from nerfro.data.frames import list_images
from tests.conftest import refused

from .formats import FORMATS, Format, change_json, few_refref_views, write_blender  # noqa: F401
from .photographs import HEIGHT, POINTS, WIDTH, check_views, picture, save_mask, save_picture

pytestmark = pytest.mark.usefixtures("few_refref_views")
every_format = pytest.mark.parametrize("form", FORMATS.values(), ids=FORMATS)
WITH_FILES = [name for name in FORMATS if name != "refref"]  # RefRef's images are rows of a table
with_files = pytest.mark.parametrize("form", [FORMATS[name] for name in WITH_FILES], ids=WITH_FILES)


@every_format
def test_points_project_onto_their_pixels_in_all_splits(form: Format, tmp_path: Path) -> None:
    source = form.open(form.write(tmp_path, masks=True))
    for split, seeds in (("train", form.train), ("test", form.test)):
        views = source.load(split).checked()
        assert views.masks is not None
        check_views(views, list(seeds), **form.lens)
        assert (views.cameras.near, views.cameras.far) == (0.5, 9.0)


@every_format
@pytest.mark.parametrize("factor", [1.3, 2, 5])
def test_downscaling_averages_pixels_and_keeps_directions(form: Format, factor: float, tmp_path: Path) -> None:
    root = form.write(tmp_path, masks=True)
    full, small = form.load(root), form.load(root, downscale=factor)
    assert (small.cameras.height, small.cameras.width) == small.images[0].shape[:2] == small.masks[0].shape
    assert (small.cameras.height, small.cameras.width) == (round(HEIGHT / factor), round(WIDTH / factor))
    points = torch.from_numpy(POINTS).float()
    ratio = torch.tensor([small.cameras.width / WIDTH, small.cameras.height / HEIGHT])
    torch.testing.assert_close(
        small.cameras.project(points)[0], full.cameras.project(points)[0] * ratio, rtol=0, atol=1e-4
    )
    if factor == 2:
        blocks = picture(form.train[0]).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3)
        np.testing.assert_allclose(small.images[0], blocks.mean((1, 3)) / 255, atol=0.51 / 65535)
        np.testing.assert_allclose(small.masks[0], (blocks[..., 0] > 127).mean((1, 3)), atol=0.51 / 65535)


@with_files
def test_masks_are_optional(form: Format, tmp_path: Path) -> None:
    assert form.load(form.write(tmp_path)).masks is None


@with_files
def test_selected_labels_define_the_object_in_every_format(form: Format, tmp_path: Path) -> None:
    views = form.load(form.write(tmp_path, masks=True))
    before = torch.stack(list(views.masks))
    for frame in views.frames:  # label 1 for the object in each mask, and label 2 for everything else
        levels = np.asarray(Image.open(frame.mask))
        Image.fromarray(np.where(levels > 0, 1, 2).astype(np.uint8)).save(frame.mask)
    assert torch.equal(torch.stack(list(form.load(tmp_path, mask_labels=[1]).masks)), before)


def test_empty_and_full_masks_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_blender(tmp_path, masks=True)
    Image.new("L", (WIDTH, HEIGHT)).save(root / "train/mask_r_1.png")
    Image.new("L", (WIDTH, HEIGHT), 255).save(root / "train/mask_r_4.png")
    BlenderData(str(root)).load("train").checked()
    out = capsys.readouterr().out
    assert "1 of 4 masks are empty (train/r_1); draw the object white" in out
    assert "1 of 4 masks are full (train/r_4)" in out


def test_mask_that_matches_two_images_is_refused(tmp_path: Path) -> None:
    root = write_blender(tmp_path)
    for split, folder in (("train", "front"), ("test", "back")):
        (root / folder).mkdir()
        save_picture(root / folder / "000000.png", 1)
        entry = {"file_path": f"{folder}/000000", "transform_matrix": np.eye(4).tolist()}
        change_json(root / f"transforms_{split}.json", lambda d, entry=entry: d.update(frames=[entry]))
    save_mask(root / "masks/000000.png", 1)
    source = BlenderData(str(root))
    assert source.load("train").masks is not None
    refused(r"masks/000000\.png is found for .*front/000000\.png and for .*back/000000", source.load, "test")
    (root / "masks/000000.png").rename(root / "mask.png")
    for split in ("train", "test"):
        change_json(root / f"transforms_{split}.json", lambda d: d["frames"][0].update(mask_path="mask.png"))
    source = BlenderData(str(root))
    assert [source.load(split).masks is not None for split in ("train", "test")] == [True, True]


@with_files
def test_masks_without_an_image_are_refused(form: Format, tmp_path: Path) -> None:
    save_mask(form.write(tmp_path) / "masks/000000.png", 1)
    refused(r"no image has a mask, although .*masks/000000\.png exist|1 masks for 6", form.load, tmp_path)


def test_masks_of_another_split_do_not_count_as_unmatched(tmp_path: Path) -> None:
    source = BlenderData(str(write_blender(tmp_path, masks=True)))
    save_mask(tmp_path / "masks/000000.png", 1)  # fits no image
    for frame in source.load("test").frames:
        frame.mask.unlink()
    assert source.load("test").masks is None


@with_files
def test_damaged_images_and_masks_are_named(form: Format, tmp_path: Path) -> None:
    frame = form.load(form.write(tmp_path, masks=True)).frames[-1]
    content, name = frame.image.read_bytes(), frame.image.name.replace(".", r"\.")
    frame.image.write_bytes(content[:-30])
    refused(rf"{name} cannot be read \(.*\); copy or export it again", lambda: form.load(tmp_path).checked())
    Image.new("RGB", (WIDTH + 2, HEIGHT)).save(frame.image)
    refused(rf"{name} has 26x18 pixels but .* has 24x18; all images of a split", form.load, tmp_path)
    Image.new("RGB", (HEIGHT, WIDTH)).save(frame.image)
    refused(r"18x24 pixels but .* has 24x18; one is upright and the other lies: rotate", form.load, tmp_path)
    frame.image.write_bytes(content)
    Image.new("L", (4, 3)).save(frame.mask)
    refused(r"mask .* has 4x3 pixels but its image has 24x18", form.load, tmp_path)
    frame.image.unlink()
    if form.source.__name__ in ("LlffData", "IdrData"):  # these match images by the order of names
        message = "holds 5 images but|for 5 images"
    else:
        message = rf"image .*{name} .*does not exist"
    refused(message, form.load, tmp_path, **({"missing": "refuse"} if form.source.__name__ == "NerfstudioData" else {}))


@every_format
def test_missing_folders_unknown_splits_and_empty_intervals_are_refused(form: Format, tmp_path: Path) -> None:
    refused(r"data\.root=.*gone is not a folder; give the folder of the data set", form.load, tmp_path / "gone")
    refused(r"has no split 'dev'; it has train, (val, )?test$", form.load, form.write(tmp_path), "dev")
    refused(r"data\.far=0\.0 are not an interval", form.open, tmp_path, far=0.0)


def test_alpha_is_dropped_unless_a_background_is_chosen(tmp_path: Path) -> None:
    root = write_blender(tmp_path)
    levels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    for path in (root / "train").iterdir():
        Image.fromarray(levels).save(path)
    colours, opacity = torch.from_numpy(levels / 255).float().split([3, 1], -1)
    torch.testing.assert_close(BlenderData(str(root)).load("train").images[0], colours)
    white = BlenderData(str(root), alpha="white").load("train").images[0]
    torch.testing.assert_close(white, colours * opacity + 1 - opacity, rtol=0, atol=1e-5)


def test_masks_and_hidden_files_are_not_images(tmp_path: Path) -> None:
    for name in ("._a.jpg", ".b.png", "mask_a.png", "notes.txt"):
        (tmp_path / name).touch()
    refused("holds no image", list_images, tmp_path)
    for name in ("b.PNG", "a.jpg"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a.jpg", "b.PNG"]
