"""NeRRF's two layouts, written here and read back."""

from __future__ import annotations

import json
import math

import pytest

from nerfro.data.nerrf import NerrfData
from nerfro.errors import NerfroError

from .photographs import FX, HEIGHT, WIDTH, camera_to_world, check_views, save_mask, save_picture

FOCAL = 0.5 * WIDTH / math.tan(math.radians(30))


@pytest.fixture
def write_synthetic(tmp_path):
    def write(numbers=(0, 1, 2, 3, 10)):
        for i in numbers:
            save_picture(tmp_path / f"image/horse/{i}_0001.png", i)
            save_mask(tmp_path / f"mask/horse/mask_{i}_0001.png", i)
            meta = tmp_path / f"meta/{i}_meta_0000.json"
            meta.parent.mkdir(exist_ok=True)
            meta.write_text(json.dumps({"cam_world_pose": camera_to_world(i, "opengl").tolist()}))
        return tmp_path / "image/horse"

    return write


@pytest.fixture
def write_captured(tmp_path):
    def write(num_images=53):
        for i in range(num_images):
            save_picture(tmp_path / f"images/IMG_{i:02d}.png", i)
            save_mask(tmp_path / f"mask/mask_IMG_{i:02d}.png", i)
            meta = tmp_path / f"meta/IMG_{i:02d}.json"
            meta.parent.mkdir(exist_ok=True)
            # The focal length is that of 672x504 pixels.
            pose = camera_to_world(i, "opengl").tolist()
            meta.write_text(json.dumps({"cam_world_pose": pose, "f": FX * 672 / WIDTH}))
        return tmp_path

    return write


def test_synthetic_scene_is_split_by_even_and_odd_numbers(write_synthetic):
    source = NerrfData(str(write_synthetic()))
    lens = {"lens": (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)}
    train = source.load("train")
    check_views(train, [0, 2, 10], **lens)
    check_views(source.load("test"), [1, 3], **lens)
    assert (train.cameras.near, train.cameras.far) == (0.02, 80)


def test_captured_scene_trains_on_the_first_fifty(write_captured):
    source = NerrfData(str(write_captured()))
    lens = {"lens": (FX, FX, WIDTH / 2, HEIGHT / 2)}
    train = source.load("train")
    check_views(train, list(range(50)), **lens)
    assert train.cameras.far == 3
    check_views(source.load("val"), [50, 51, 52], **lens)


def test_what_is_wrong_is_named(write_synthetic, write_captured, tmp_path):
    root = write_synthetic((0, 2))
    with pytest.raises(NerfroError, match=r"no image <id>_0001\.png of odd id"):
        NerrfData(str(root)).load("test")
    meta = tmp_path / "meta/2_meta_0000.json"
    for content, message in (
        ("{", "is not valid JSON"),
        ("[]", "has no 'cam_world_pose'"),
        ('{"cam_world_pose": [[1, 2]]}', "cam_world_pose has shape 1x2"),
    ):
        meta.write_text(content)
        with pytest.raises(NerfroError, match=message):
            NerrfData(str(root)).load("train")
    meta.unlink()
    with pytest.raises(NerfroError, match=r"2_meta_0000\.json cannot be read .* every image needs its pose"):
        NerrfData(str(root)).load("train")
    with pytest.raises(NerfroError, match="no more than the 50 images that are trained on"):
        NerrfData(str(write_captured(2))).load("test")
    with pytest.raises(NerfroError, match="is not a folder"):
        NerrfData(str(tmp_path / "gone")).load("train")
