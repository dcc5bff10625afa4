"""The OpenCV loader against OpenCV's own projection, and against the Blender loader."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from nerfro.data.blender import BlenderData
from nerfro.data.opencv import OpenCVData
from nerfro.errors import NerfroError

CAM_MAT = [[11.0, 0.0, 3.6], [0.0, 10.0, 2.9], [0.0, 0.0, 1.0]]
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def write_opencv(write_blender, random_image):
    """Write a split with `CAM_MAT`, file names with extensions, and random poses."""

    def write(num_images=3, split="train", masks=(), cam_mat=CAM_MAT):
        pictures = [random_image(i) for i in range(num_images)]
        root = write_blender(pictures, masks=masks, split=split, suffix=".png")
        path = root / f"transforms_{split}.json"
        frames = json.loads(path.read_text())["frames"]
        path.write_text(json.dumps({"cam_mat": cam_mat, "frames": frames}))
        return root

    return write


@pytest.mark.parametrize("downscale", [1, 2])
def test_points_on_rays_project_onto_their_pixels(write_opencv, downscale, random_pose):
    cameras = OpenCVData(str(write_opencv()), downscale=downscale).load("train").cameras
    scaled = np.diag([1 / downscale, 1 / downscale, 1]) @ np.array(CAM_MAT)
    for view in range(3):
        rays = cameras.image_rays(view)
        points = (rays.origins + 2.5 * rays.directions).double().numpy()
        # x ~ K (R x + t): y down, z forward.
        world_to_camera = np.linalg.inv(random_pose(view))[:3]
        image = (np.c_[points, np.ones(len(points))] @ world_to_camera.T) @ scaled.T
        assert (image[:, 2] > 0).all()
        row, column = np.divmod(np.arange(len(points)), 8 // downscale)
        np.testing.assert_allclose(image[:, :2] / image[:, 2:], np.stack([column, row], -1) + 0.5, atol=1e-4)


def test_both_loaders_agree_on_the_same_cameras(write_opencv, write_blender, edit_transforms):
    root = write_opencv(cam_mat=[[4.0, 0, 4.0], [0, 4.0, 3.0], [0, 0, 1]])
    opencv = OpenCVData(str(root), near=2.0, far=6.0).load("train")

    def turn_axes(document: dict) -> None:
        document["camera_angle_x"] = np.pi / 2  # half the width 4 at focal length 4
        for frame in document["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ TO_OPENCV).tolist()

    edit_transforms(root, turn_axes)
    blender = BlenderData(str(root)).load("train")
    assert all(map(torch.equal, opencv.images, blender.images))
    for view in range(3):
        ours, theirs = opencv.cameras.image_rays(view), blender.cameras.image_rays(view)
        torch.testing.assert_close(ours.directions, theirs.directions)
        torch.testing.assert_close(ours.radii, theirs.radii)


def test_evaluation_images_are_cropped_with_their_rays_and_training_images_are_not(write_opencv):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:5, 1:4] = 255
    root = write_opencv(1, "test", masks=[mask])
    (root / "transforms_train.json").write_text((root / "transforms_test.json").read_text())
    source = OpenCVData(str(root), eval_crop=0.5)
    full, test = source.load("train"), source.load("test")
    # Half of 6 // 2 is 1 and of 8 // 2 is 2, to each side of the centre.
    assert test.images[0].shape == (2, 4, 3)
    assert full.images[0].shape == (6, 8, 3)
    assert torch.equal(test.images[0], full.images[0][2:4, 2:6])
    assert torch.equal(test.masks[0], full.masks[0][2:4, 2:6])
    directions = full.cameras.image_rays(0).directions.reshape(6, 8, 3)[2:4, 2:6]
    torch.testing.assert_close(test.cameras.image_rays(0).directions.reshape(2, 4, 3), directions)


@pytest.mark.parametrize(
    ("cam_mat", "message"),
    [
        (None, "cam_mat is not a matrix|cam_mat has shape"),
        ([[1.0, 0], [0, 1]], "cam_mat has shape 2x2; give 3x3 numbers"),
        ([[np.nan, 0, 4], [0, 9, 3], [0, 0, 1]], "cam_mat holds NaN"),
        ([[-9.0, 0, 4], [0, 9, 3], [0, 0, 1]], "cam_mat must have positive focal lengths and no skew"),
        ([[9.0, 1, 4], [0, 9, 3], [0, 0, 1]], "cam_mat must have positive focal lengths and no skew"),
        ([[9.0, 0, 4], [0, 9, 3], [0, 0, 2]], r"cam_mat must have the last row 0, 0, 1"),
    ],
)
def test_wrong_camera_matrix_is_refused(write_opencv, cam_mat, message):
    with pytest.raises(NerfroError, match=message):
        OpenCVData(str(write_opencv(1, cam_mat=cam_mat))).load("train")


def test_missing_camera_matrix_is_named(write_opencv, edit_transforms):
    root = write_opencv(1)
    edit_transforms(root, lambda document: document.pop("cam_mat"))
    with pytest.raises(NerfroError, match=r"has no 'cam_mat' \(the 3x3 camera matrix in pixels\); add it"):
        OpenCVData(str(root)).load("train")


def test_camera_matrix_of_another_image_size_gives_a_warning(write_opencv):
    root = write_opencv(1, cam_mat=[[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    with pytest.warns(UserWarning, match=r"principal point \(16, 12\) outside the 8x6 pixels"):
        OpenCVData(str(root)).load("train")


@pytest.mark.parametrize("share", [0.0, -1.0, 1.2])
def test_impossible_crop_is_refused(share):
    with pytest.raises(NerfroError, match=f"eval_crop={share} is not allowed"):
        OpenCVData("anywhere", eval_crop=share)


@pytest.mark.parametrize("nested", [False, True])
def test_distortion_in_opencvs_order_bends_the_rays(write_opencv, edit_transforms, nested, random_pose):
    root = write_opencv(2)
    numbers = [-0.1, 0.02, 0.003, -0.002, 0.001]
    edit_transforms(root, lambda document: document.update(dist=[numbers] if nested else numbers))
    rays = OpenCVData(str(root)).load("train").cameras.image_rays(1)
    points = (rays.origins + 2.5 * rays.directions).double().numpy()
    x, y, z = np.linalg.inv(random_pose(1))[:3] @ np.c_[points, np.ones(len(points))].T
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = numbers
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    row, column = np.divmod(np.arange(len(points)), 8)
    np.testing.assert_allclose(CAM_MAT[0][0] * u + CAM_MAT[0][2], column + 0.5, atol=1e-4)
    np.testing.assert_allclose(CAM_MAT[1][1] * v + CAM_MAT[1][2], row + 0.5, atol=1e-4)


@pytest.mark.parametrize("dist", [[0.1], "none", [1, 2, 3, None], [[0.1, 0.2]]])
def test_wrong_distortion_is_refused(write_opencv, edit_transforms, dist):
    root = write_opencv(1)
    edit_transforms(root, lambda document: document.update(dist=dist))
    with pytest.raises(NerfroError, match="must be 4, 5 or 8 numbers in OpenCV's order"):
        OpenCVData(str(root)).load("train")


@pytest.mark.parametrize("downscale", [1.3, 2.5, 5])
def test_any_downscale_keeps_the_directions(write_opencv, downscale):
    root = str(write_opencv())
    full, small = OpenCVData(root).load("train"), OpenCVData(root, downscale=downscale).load("train")
    height, width = small.images[0].shape[:2]
    assert (
        (small.cameras.height, small.cameras.width)
        == (height, width)
        == tuple(max(1, round(side / downscale)) for side in full.images[0].shape[:2])
    )
    # A pixel of the small picture covers this much of the full one, and the whole picture is there.
    share = torch.tensor([full.cameras.width / width, full.cameras.height / height])
    rays = small.cameras.image_rays(0)
    seen = full.cameras.project(rays.origins + 3 * rays.directions)[0][0]
    row, column = np.divmod(np.arange(height * width), width)
    torch.testing.assert_close(
        seen, torch.tensor(np.stack([column + 0.5, row + 0.5], 1)).float() * share, atol=1e-3, rtol=0
    )
