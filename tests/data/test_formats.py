"""Properties that all data formats share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.data.blender import BlenderData
from nerfro.data.frames import list_images
from nerfro.errors import NerfroError

from .formats import FORMATS, Format, few_refref_views, write_blender  # noqa: F401
from .photographs import HEIGHT, POINTS, WIDTH, check_views, picture

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
def test_damaged_images_and_masks_are_named(form: Format, tmp_path: Path) -> None:
    frame = form.load(form.write(tmp_path, masks=True)).frames[-1]
    content, name = frame.image.read_bytes(), frame.image.name.replace(".", r"\.")
    frame.image.write_bytes(content[:-30])
    with pytest.raises(NerfroError, match=rf"{name} cannot be read \(.*\); copy or export it again"):
        form.load(tmp_path).checked()
    Image.new("RGB", (WIDTH + 2, HEIGHT)).save(frame.image)
    with pytest.raises(NerfroError, match=rf"{name} has 26x18 pixels but .* has 24x18; all images of a split"):
        form.load(tmp_path)
    frame.image.write_bytes(content)
    Image.new("L", (4, 3)).save(frame.mask)
    with pytest.raises(NerfroError, match=r"mask .* has 4x3 pixels but its image has 24x18"):
        form.load(tmp_path)
    frame.image.unlink()
    if form.source.__name__ in ("LlffData", "IdrData"):  # these match images by the order of names
        message = "holds 5 images but|for 5 images"
    else:
        message = rf"image .*{name} .*does not exist"
    with pytest.raises(NerfroError, match=message):
        form.load(tmp_path, **({"missing": "refuse"} if form.source.__name__ == "NerfstudioData" else {}))


@every_format
def test_missing_folders_unknown_splits_and_empty_intervals_are_refused(form: Format, tmp_path: Path) -> None:
    with pytest.raises(NerfroError, match=r"data\.root=.*gone is not a folder; give the folder of the data set"):
        form.load(tmp_path / "gone")
    with pytest.raises(NerfroError, match=r"has no split 'dev'; it has train, (val, )?test$"):
        form.load(form.write(tmp_path), "dev")
    with pytest.raises(NerfroError, match=r"data\.far=0\.0 are not an interval"):
        form.open(tmp_path, far=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": 6.0, "far": 6.0}, r"data.near=6.0 and data.far=6.0 are not an interval; take 0 <= near < far"),
        ({"near": 7.0}, "data.near=7.0 and data.far=6.0 are not an interval"),
        ({"near": -1.0}, "near=-1.0 is not allowed"),
        ({"near": math.nan}, "near=nan is not allowed"),
        ({"far": math.inf}, "far=inf is not allowed"),
        ({"downscale": 0}, "downscale=0 is not allowed; take at least 1"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(NerfroError, match=message):
        BlenderData("anywhere", **options)


@pytest.mark.parametrize("data", ["colmap", "llff", "nerfstudio", "idr", "refref"])
def test_a_missing_folder_is_one_line_on_the_command_line(
    train_here: Callable[..., Any], tmp_path: Path, data: str
) -> None:
    finished = train_here(f"data={data}", f"data.root={tmp_path / 'gone'}", "trainer.max_steps=1", "logger=none")
    assert finished.code == 1
    (line,) = finished.err.strip().splitlines()
    assert f"data.root={tmp_path / 'gone'}" in line


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
    with pytest.raises(NerfroError, match="holds no image"):
        list_images(tmp_path)
    for name in ("b.PNG", "a.jpg"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a.jpg", "b.PNG"]
