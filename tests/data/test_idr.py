"""Matrices of IDR and NeuS are decomposed into the cameras that they were made of."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfro.data.base import Views
from nerfro.data.formats import idr
from tests.conftest import refused

from .formats import SCALE, SHIFT, write_idr
from .photographs import POINTS, picture, save_mask

IdrData, decompose = idr.IdrData, idr.decompose


# Pixel centres are whole numbers in these files.
@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    return lambda **changes: write_idr(tmp_path, masks=True, **changes)


def load(root: Path, split: str = "train", **options: Any) -> Views:
    return IdrData(str(root), **{"test_every": 3} | options).load(split)


def test_near_and_far_enclose_the_unit_sphere(write):
    cameras = load(write()).cameras
    assert (cameras.near, cameras.far) == (pytest.approx(2), pytest.approx(4))  # all cameras are at distance 3


def test_world_of_the_file_is_kept_on_request(write):
    cameras = load(write(), world="file", near=1.0, far=20.0).cameras
    world = torch.from_numpy(POINTS * SCALE + SHIFT).float()
    inside = load(write()).cameras.project(torch.from_numpy(POINTS).float())
    torch.testing.assert_close(cameras.project(world)[0], inside[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(cameras.project(world)[1], SCALE * inside[1])
    refused(r"data.world=file needs data.near and data.far", IdrData, str(write()), world="file")


def test_masks_are_read_beside_the_images_without_a_mask_folder(tmp_path: Path) -> None:
    write_idr(tmp_path)
    for i in range(6):
        save_mask(tmp_path / "image" / f"mask_{i:06d}.png", i)
    views = load(tmp_path)
    assert views.masks is not None
    np.testing.assert_array_equal(views.masks[0].numpy(), picture(1)[..., 0] > 127)


def test_hidden_files_among_the_masks_are_ignored(write: Callable[..., Path]) -> None:
    root = write()
    expected = load(root).masks
    (root / "mask" / "._000.png").write_bytes(b"of another system")
    assert torch.equal(torch.stack(list(load(root).masks)), torch.stack(list(expected)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world_mat_5": None}, "has 5 matrices world_mat_<i> for 6 images; the numbers must be equal"),
        ({"scale_mat_2": None}, "has no 'scale_mat_2'; every image needs one"),
        ({"world_mat_1": np.eye(3)}, "world_mat_1 has shape 3x3; give 4x4 numbers"),
        ({"world_mat_1": np.full((4, 4), np.nan)}, "world_mat_1 holds NaN"),
        ({"world_mat_1": np.diag([1.0, 1, 0, 1])}, "world_mat_1 is singular"),
        (
            {"world_mat_1": np.array([[9.0, 2, 4, 0], [0, 9, 3, 0], [0, 0, 1, 5], [0, 0, 0, 1]])},
            "must have no skew",
        ),
        # Of a test view; bounds are estimated from all views.
        ({"world_mat_0": [[31.0, 0, 12, 1e30], [0, 31, 9, 0], [0, 0, 1, 5], [0, 0, 0, 1]]}, r"data\.far=.*e\+28"),
    ],
)
def test_wrong_matrices_are_refused(write, changes, message):
    refused(message, load, write(**changes))


def test_missing_files_are_named(write, tmp_path):
    refused(r"image is not a folder; it should hold the images", load, tmp_path)
    root = write()
    refused(r"cameras_large\.npz does not exist; set data.cameras", load, root, cameras="cameras_large.npz")
    (root / "mask/002.png").unlink()
    refused("holds 5 masks for 6 images", load, root)
    (root / "cameras_sphere.npz").write_bytes(b"PK\3\4 cut off")
    (root / "mask/002.png").write_bytes(b"")
    refused(r"cameras_sphere\.npz is not a readable \.npz", load, root)
