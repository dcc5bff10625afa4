"""LLFF's poses_bounds.npy in its own world and in the frames of LLFF and Eikonal Fields."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfro.data.base import Views
from nerfro.data.formats import llff
from tests.conftest import refused

from .formats import FAR, IDEAL, NEAR, write_llff
from .photographs import FX, HEIGHT, POINTS, WIDTH, project

LlffData, frame_transform = llff.LlffData, llff.frame_transform
map_poses, read_poses_bounds = llff.map_poses, llff.read_poses_bounds


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    return lambda *seeds, folder="", **changes: write_llff(tmp_path / folder, seeds=seeds or range(6), **changes)


def transformed(root: Path, frame: str) -> tuple[np.ndarray, np.ndarray]:
    """The file's poses, and the transformation to a frame."""
    poses, depths, _ = read_poses_bounds(root / "poses_bounds.npy")
    return poses, frame_transform(poses, depths, frame)


def load(root: Path, split: str = "train", **options: Any) -> Views:
    return LlffData(str(root), **{"frame": "file", "test_every": 3} | options).load(split)


@pytest.mark.parametrize("frame", ["llff", "eikonal"])
def test_frame_is_a_similarity_transformation_of_the_scene(write, frame):
    root = write()
    _, transform = transformed(root, frame)
    linear = transform[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    np.testing.assert_allclose(linear.T @ linear, scale**2 * np.eye(3), atol=1e-12)
    moved = torch.from_numpy(POINTS @ linear.T + transform[:3, 3]).float()
    views = load(root, frame=frame)
    pixels, depth = views.cameras.project(moved)
    for view, seed in enumerate([1, 2, 4, 5]):
        np.testing.assert_allclose(pixels[view].double().numpy(), project(seed, lens=IDEAL), atol=2e-4)
    torch.testing.assert_close(depth, load(root).cameras.project(torch.from_numpy(POINTS).float())[1] * float(scale))


def test_llff_frame_is_scaled_by_the_least_depth_and_centred_on_the_average_camera(write):
    poses, transform = transformed(write(), "llff")
    assert np.cbrt(np.linalg.det(transform[:3, :3])) == pytest.approx(1 / (0.75 * NEAR))
    mapped = map_poses(poses, transform)
    np.testing.assert_allclose(mapped[:, :, 3].mean(0), 0, atol=1e-12)
    back = mapped[:, :, 2].mean(0)
    np.testing.assert_allclose(back[:2], 0, atol=1e-12)  # the cameras look along -z on average
    assert back[2] > 0
    assert abs(mapped[:, :, 1].mean(0)[0]) < 1e-12  # and up has no part to the side


def test_eikonal_frame_is_spherified(write):
    poses, transform = transformed(write(), "eikonal")
    mapped = map_poses(poses, transform)
    centres, axes = mapped[:, :, 3], mapped[:, :, 2]
    assert np.square(centres).sum(-1).mean() == pytest.approx(1)
    mean = centres.mean(0)
    np.testing.assert_allclose(mean[:2], 0, atol=1e-12)
    assert mean[2] > 0

    def miss(point):  # summed squared distance of a point to the optical axes
        return np.square(np.cross(point - centres, axes)).sum()

    steps = 1e-3 * np.vstack([np.eye(3), -np.eye(3)])
    assert all(miss(step) > miss(np.zeros(3)) for step in steps)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=-1), 1)


def test_bounds_are_scaled_to_the_frame(write):
    root = write()
    corner = np.hypot(1, np.hypot(WIDTH, HEIGHT) / 2 / FX)
    own = load(root).cameras
    assert (own.near, own.far) == (pytest.approx(0.9 * NEAR), pytest.approx(FAR * corner))
    scaled = load(root, frame="llff").cameras
    assert scaled.near == pytest.approx(0.9 / 0.75)
    assert scaled.far == pytest.approx(FAR / (0.75 * NEAR) * corner)
    scale = np.cbrt(np.linalg.det(transformed(root, "eikonal")[1][:3, :3]))
    assert load(root, frame="eikonal").cameras.far == pytest.approx(min(FAR * scale, 2.0) * corner)
    given = load(root, near=0.1, far=7.0).cameras
    assert (given.near, given.far) == (0.1, 7.0)


def test_far_encloses_the_farthest_depth_in_the_image_with_the_widest_field_of_view(write):
    root = write()
    rows = np.load(root / "poses_bounds.npy")
    rows[3, 14] = FX / 3  # focal length of a test view
    np.save(root / "poses_bounds.npy", rows)
    expected = FAR * np.hypot(1, np.hypot(WIDTH, HEIGHT) / 2 / (FX / 3))
    assert [load(root, split).cameras.far for split in ("train", "test")] == pytest.approx([expected] * 2)


@pytest.mark.parametrize("frame", ["file", "llff", "eikonal"])
def test_video_frames_are_mapped_with_the_training_transformation(write, frame):
    # Videos of other depths and another path: a transformation of their own would be another one.
    root = write()
    write(9, 7, folder="video")
    train = load(root, frame=frame, video="video")
    assert len(train) == 6
    test = load(root, "test", frame=frame, video="video")
    assert test.names == ["img_000.png", "img_001.png"]
    assert (test.cameras.near, test.cameras.far) == (train.cameras.near, train.cameras.far)
    _, transform = transformed(root, frame)
    moved = torch.from_numpy(POINTS @ transform[:3, :3].T + transform[:3, 3]).float()
    for view, seed in enumerate((9, 7)):
        found = test.cameras.project(moved)[0][view].double().numpy()
        np.testing.assert_allclose(found, project(seed, lens=IDEAL), atol=2e-4)


def test_wrong_files_are_refused(write):
    root = write()
    path = root / "poses_bounds.npy"
    rows = np.load(path)
    turned = rows.copy()
    turned[2, :3] *= 2
    for content, message in (
        (rows[:4], r"holds 6 images but .*poses_bounds.npy has 4 poses"),
        (rows[:, :15], r"has shape \(6, 15\); it must be \[images, 17\]"),
        (np.where(np.arange(17) == 16, 0.1, rows), "depths must be positive and ascend"),
        (np.where(np.arange(17) == 3, np.nan, rows), "holds NaN or infinite numbers in row 0"),
        (turned, "row 2: the 3x3 part of the pose is not a rotation"),
        (np.where(np.arange(17) == 16, 1e30, rows), r"data\.far=1.* is not allowed; take at least 0"),
    ):
        np.save(path, content)
        refused(message, load, root)
    path.write_bytes(path.read_bytes()[:200])
    refused(r"poses_bounds\.npy cannot be read", load, root)
    path.unlink()
    refused("does not exist; create it with LLFF", load, root)


def test_parallel_cameras_have_no_sphere():
    poses = np.tile(np.eye(4)[:3], (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    refused("all optical axes are parallel", frame_transform, poses, np.array([[1.0, 2.0]] * 4), "eikonal")
    assert np.isfinite(frame_transform(poses, np.array([[1.0, 2.0]] * 4), "llff")).all()
