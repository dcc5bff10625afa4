"""The Blender loader: what it reads, and one clear line for everything that it cannot."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfro.data.blender import BlenderData
from nerfro.errors import NerfroError


def test_images_poses_and_names_are_read_in_the_files_order(write_blender, random_image, random_pose):
    pictures = [random_image(i) for i in range(3)]
    views = BlenderData(str(write_blender(pictures))).load("train")
    torch.testing.assert_close(torch.stack(list(views.images)), torch.from_numpy(np.stack(pictures) / 255).float())
    poses = torch.from_numpy(np.stack([random_pose(i)[:3] for i in range(3)])).float()
    assert torch.equal(views.cameras.camera_to_world, poses)
    assert views.names == ["train/r_0", "train/r_1", "train/r_2"]
    assert len(views) == 3
    assert views.masks is None
    assert (views.cameras.near, views.cameras.far) == (2.0, 6.0)


@pytest.mark.parametrize("downscale", [1, 2])
def test_field_of_view_spans_the_width_at_any_size(write_blender, downscale, random_image):
    angle = 0.6911
    root = write_blender([random_image(0)], [np.eye(4)], angle=angle)
    cameras = BlenderData(str(root), downscale=downscale).load("train").cameras
    assert (cameras.width, cameras.height) == (8 // downscale, 6 // downscale)
    edge = torch.tensor([[0.0, 0.5]])
    left = cameras.rays(torch.tensor([0]), torch.tensor([cameras.height // 2]), torch.tensor([0]), edge).directions
    assert math.atan2(-left[0, 0], -left[0, 2]) == pytest.approx(angle / 2, rel=1e-5)


def test_camera_at_identity_looks_along_minus_z(write_blender, random_image):
    cameras = BlenderData(str(write_blender([random_image(0)], [np.eye(4)]))).load("train").cameras
    directions = cameras.image_rays(0).directions.reshape(6, 8, 3)
    assert torch.allclose(directions.mean((0, 1))[:2], torch.zeros(2), atol=1e-6)
    assert (directions[..., 2] < 0).all()
    assert directions[0, 0, 0] < 0 < directions[0, 0, 1]


def test_downscaling_averages_blocks_of_images_and_masks(write_blender, random_image):
    picture, mask = random_image(0), np.where(random_image(1, num_channels=1)[..., 0] > 99, 255, 0).astype(np.uint8)
    views = BlenderData(str(write_blender([picture], masks=[mask])), downscale=2).load("train")
    mean = picture.reshape(3, 2, 4, 2, 3).mean((1, 3)) / 255
    torch.testing.assert_close(views.images[0], torch.from_numpy(mean).float())
    share = mask.reshape(3, 2, 4, 2).mean((1, 3)) / 255
    torch.testing.assert_close(views.masks[0], torch.from_numpy(share).float())


def test_file_path_may_have_its_extension(write_blender, random_image):
    pictures = [random_image(i) for i in range(2)]
    views = BlenderData(str(write_blender(pictures, suffix=".png"))).load("train")
    assert views.names == ["train/r_0.png", "train/r_1.png"]
    assert [image.shape for image in views.images] == 2 * [(6, 8, 3)]


def test_dot_in_a_name_is_no_extension(write_blender, edit_transforms, random_image):
    root = write_blender([random_image(0)])
    (root / "train" / "r_0.png").rename(root / "train" / "r.001.png")
    edit_transforms(root, lambda document: document["frames"][0].update(file_path="train/r.001"))
    assert BlenderData(str(root)).load("train").names == ["train/r.001"]


def test_alpha_is_dropped_unless_a_background_is_chosen(write_blender, random_image):
    picture = random_image(0, num_channels=4)
    root = str(write_blender([picture]))
    colours, opacity = torch.from_numpy(picture / 255).float().split([3, 1], -1)
    torch.testing.assert_close(BlenderData(root).load("train").images[0], colours)
    white = BlenderData(root, alpha="white").load("train").images[0]
    torch.testing.assert_close(white, colours * opacity + 1 - opacity)


def test_masks_are_found_beside_the_images_or_by_mask_path(write_blender, edit_transforms, random_image):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4, 3:7] = 255
    root = write_blender([random_image(0)], masks=[mask])
    beside = BlenderData(str(root)).load("train").masks[0]
    assert torch.equal(beside, torch.from_numpy(mask / 255).float())
    (root / "masks").mkdir()
    (root / "train" / "mask_r_0.png").rename(root / "masks" / "other.png")
    assert BlenderData(str(root)).load("train").masks is None
    edit_transforms(root, lambda document: document["frames"][0].update(mask_path="./masks/other.png"))
    assert torch.equal(BlenderData(str(root)).load("train").masks[0], beside)


def test_splits_are_listed_in_the_usual_order(write_blender, random_image):
    root = write_blender([random_image(0)])
    for name in ("transforms_test.json", "transforms_extra.json", "val_transforms.json"):
        (root / name).write_text((root / "transforms_train.json").read_text())
    source = BlenderData(str(root))
    assert source.splits == ["train", "val", "test", "extra"]
    assert all(len(source.load(split)) == 1 for split in source.splits)


def test_unknown_split_names_those_that_exist(write_blender, random_image):
    with pytest.raises(NerfroError, match=r"has no split 'tset'; it has train$"):
        BlenderData(str(write_blender([random_image(0)]))).load("tset")


def test_missing_folder_and_folder_without_transforms_are_named(tmp_path: Path):
    with pytest.raises(NerfroError, match=r"is not a folder; give the one that holds transforms_train\.json"):
        BlenderData(str(tmp_path / "nowhere")).load("train")
    with pytest.raises(NerfroError, match=r"holds no transforms_<split>\.json"):
        BlenderData(str(tmp_path)).load("train")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": 6.0, "far": 6.0}, r"data.near=6.0 and data.far=6.0 are no interval; take 0 <= near < far"),
        ({"near": 7.0}, "data.near=7.0 and data.far=6.0 are no interval"),
        ({"near": -1.0}, "near=-1.0 is not allowed"),
        ({"near": math.nan}, "near=nan is not allowed"),
        ({"far": math.inf}, "far=inf is not allowed"),
        ({"downscale": 0}, "downscale=0 is not allowed; take at least 1"),
    ],
)
def test_option_out_of_range_is_refused(options, message):
    with pytest.raises(NerfroError, match=message):
        BlenderData("anywhere", **options)


def test_truncated_transforms_file_is_named(write_blender, random_image):
    root = write_blender([random_image(0)])
    path = root / "transforms_train.json"
    path.write_text(path.read_text()[:-40])
    with pytest.raises(NerfroError, match=r"transforms_train\.json is not valid JSON \(.*\): truncated\?"):
        BlenderData(str(root)).load("train")


def set_pose(row: int, column: int, value: object):
    def change(document: dict) -> None:
        document["frames"][1]["transform_matrix"][row][column] = value

    return change


def mirror(document: dict) -> None:
    matrix = np.array(document["frames"][1]["transform_matrix"])
    matrix[:3, 0] *= -1
    document["frames"][1]["transform_matrix"] = matrix.tolist()


def scale(document: dict) -> None:
    matrix = np.array(document["frames"][1]["transform_matrix"])
    matrix[:3, :3] *= 1.1
    document["frames"][1]["transform_matrix"] = matrix.tolist()


FRAME = r"transforms_train\.json: frame 1 \('train/r_1'\)"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("frames"), r"transforms_train\.json has no list 'frames'"),
        (lambda d: d.update(frames=[]), r"transforms_train\.json has an empty list 'frames'; a split needs"),
        (lambda d: d.update(frames=["train/r_0"]), r"transforms_train\.json: frame 0 is not an object"),
        (lambda d: d.pop("camera_angle_x"), r"transforms_train\.json has no 'camera_angle_x' \(the horizontal field"),
        (lambda d: d.update(camera_angle_x="wide"), "camera_angle_x='wide' must be an angle between 0 and pi"),
        (lambda d: d.update(camera_angle_x=math.nan), "camera_angle_x=nan must be an angle"),
        (lambda d: d.update(camera_angle_x=39.6), "camera_angle_x=39.6 must be an angle between 0 and pi, in radians"),
        (lambda d: d["frames"][1].pop("file_path"), r"transforms_train\.json: frame 1 has no 'file_path'"),
        (lambda d: d["frames"][1].pop("transform_matrix"), r"frame 1 has no 'transform_matrix'"),
        (lambda d: d["frames"][1].update(file_path=3), "'file_path' and 'mask_path' must be text"),
        (lambda d: d["frames"][1].update(file_path="train/r_0"), "'train/r_0' occurs in several frames"),
        (lambda d: d["frames"][1].update(file_path="train/r_0.png"), "'train/r_0', 'train/r_0.png' occurs in several"),
        (
            lambda d: d["frames"][1].update(file_path="train/no"),
            r"\('train/no'\): image .*no\.png does not exist",
        ),
        (lambda d: d["frames"][1].update(mask_path="no.png"), r"mask .*no\.png of .*r_1\.png does not exist"),
        (lambda d: d.update(w=9, h=6), r"r_0\.png has 8x6 pixels where 9x6 are expected"),
        (lambda d: d.update(w="wide", h=6), "w='wide' and h=6 must be numbers of pixels"),
        (set_pose(0, 3, math.nan), FRAME + ": transform_matrix holds NaN or infinite numbers"),
        (set_pose(0, 3, math.inf), FRAME + ": transform_matrix holds NaN or infinite numbers"),
        (set_pose(0, 3, "x"), FRAME + ": transform_matrix is not a matrix of numbers; give 4x4 or 3x4 numbers"),
        (set_pose(3, 0, 0.5), FRAME + ": the last row of transform_matrix is .* it must be 0, 0, 0, 1"),
        (lambda d: d["frames"][1].update(transform_matrix=[1, 2]), FRAME + ": transform_matrix has shape 2; give 4x4"),
        (lambda d: d["frames"][1].update(transform_matrix=None), FRAME + ": transform_matrix"),
        (mirror, FRAME + r": the 3x3 part of transform_matrix is no rotation \(it mirrors\)"),
        (scale, FRAME + r": the 3x3 part of transform_matrix is no rotation \(it is off by 0.21\)"),
    ],
)
def test_wrong_transforms_file_gives_one_clear_line(write_blender, edit_transforms, change, message, random_image):
    root = write_blender([random_image(i) for i in range(3)])
    edit_transforms(root, change)
    with pytest.raises(NerfroError, match=message) as caught:
        BlenderData(str(root)).load("train")
    assert "\n" not in str(caught.value)


def test_transforms_file_that_is_a_list_is_refused(write_blender, random_image):
    root = write_blender([random_image(0)])
    (root / "transforms_train.json").write_text(json.dumps([1, 2]))
    with pytest.raises(NerfroError, match="has no list 'frames'"):
        BlenderData(str(root)).load("train")


def test_images_of_different_sizes_are_refused(write_blender, random_image):
    root = write_blender([random_image(0), random_image(1, width=10)])
    with pytest.raises(NerfroError, match=r"r_1\.png has 10x6 pixels but .*r_0\.png has 8x6; all images of a split"):
        BlenderData(str(root)).load("train")


def test_mask_of_another_size_is_refused(write_blender, random_image):
    root = write_blender([random_image(0)], masks=[np.zeros((3, 4), np.uint8)])
    with pytest.raises(NerfroError, match=r"mask_r_0\.png has 4x3 pixels but its image has 8x6"):
        BlenderData(str(root)).load("train")


def test_corrupt_image_is_named(write_blender, random_image):
    root = write_blender([random_image(i) for i in range(3)])
    path = root / "train" / "r_2.png"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(NerfroError, match=r"r_2\.png cannot be read \(.*\); copy or export it again"):
        BlenderData(str(root)).load("train").checked()


def test_pose_of_three_rows_is_accepted(write_blender, edit_transforms, random_image):
    root = write_blender([random_image(0)])
    edit_transforms(root, lambda document: document["frames"][0]["transform_matrix"].pop())
    assert BlenderData(str(root)).load("train").cameras.camera_to_world.shape == (1, 3, 4)


def test_rounded_rotation_is_accepted(write_blender, random_image, random_pose):
    root = write_blender([random_image(0)], [np.round(random_pose(0), 4)])
    assert len(BlenderData(str(root)).load("train")) == 1
