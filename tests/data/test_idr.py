"""IDR's and NeuS's matrices, written here and taken apart again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfro.data.idr import IdrData, decompose
from nerfro.errors import NerfroError

from .photographs import CX, CY, FX, FY, POINTS, check_views, save_mask, save_picture, world_to_camera

# Pixel centres are whole numbers in these files.
K = np.array([[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]])
SCALE, SHIFT = 2.5, np.array([0.3, -0.2, 0.7])


@pytest.fixture
def write(tmp_path):
    """Write five views whose object frame is the one of `photographs`, in a world that is larger and elsewhere."""

    def write(num_images=5, masks=True, **changes):
        scale = np.diag([SCALE, SCALE, SCALE, 1.0])
        scale[:3, 3] = SHIFT
        arrays = {}
        for i in range(num_images):
            save_picture(tmp_path / f"image/{i:06d}.png", i)
            if masks:
                save_mask(tmp_path / f"mask/{i:03d}.png", i)  # DTU: shorter numbers than the images'
            matrix = np.vstack([K @ world_to_camera(i), [0, 0, 0, 1]]) @ np.linalg.inv(scale)
            arrays |= {f"world_mat_{i}": matrix.astype(np.float32), f"scale_mat_{i}": scale, f"camera_mat_{i}": K}
        arrays |= changes
        np.savez(tmp_path / "cameras_sphere.npz", **{k: v for k, v in arrays.items() if v is not None})
        return tmp_path

    return write


def load(root, split="train", **options):
    return IdrData(str(root), **{"test_every": 3} | options).load(split)


def test_points_of_the_unit_sphere_project_onto_their_pixels(write):
    root = write()
    check_views(load(root), [1, 2, 4])
    check_views(load(root, "test"), [0, 3])


def test_near_and_far_enclose_the_unit_sphere(write):
    cameras = load(write()).cameras
    assert (cameras.near, cameras.far) == (pytest.approx(2), pytest.approx(4))  # all cameras are at distance 3


def test_the_files_own_world(write):
    cameras = load(write(), world="file", near=1.0, far=20.0).cameras
    import torch

    world = torch.from_numpy(POINTS * SCALE + SHIFT).float()
    inside = load(write()).cameras.project(torch.from_numpy(POINTS).float())
    torch.testing.assert_close(cameras.project(world)[0], inside[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(cameras.project(world)[1], SCALE * inside[1])
    with pytest.raises(NerfroError, match=r"data.world=file needs data.near and data.far"):
        IdrData(str(write()), world="file")


@pytest.mark.parametrize("factor", [1.0, -3.0, 1e-3])
def test_decomposition_does_not_depend_on_the_matrix_factor(factor):
    rotation = Rotation.random(random_state=3).as_matrix()
    centre = np.array([0.4, -2.0, 1.0])
    projection = factor * K @ np.column_stack([rotation, -rotation @ centre])
    pose, lens = decompose(projection, "here")
    np.testing.assert_allclose(pose[:, :3], rotation.T, atol=1e-12)
    np.testing.assert_allclose(pose[:, 3], centre, atol=1e-12)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((FX, FY, CX, CY))


def test_data_without_masks(write):
    root = write(masks=False)
    assert load(root).masks is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world_mat_4": None}, "has 4 matrices world_mat_<i> for 5 images; make them equal"),
        ({"scale_mat_2": None}, "has no 'scale_mat_2'; every image needs one"),
        ({"world_mat_1": np.eye(3)}, "world_mat_1 has shape 3x3; give 4x4 numbers"),
        ({"world_mat_1": np.full((4, 4), np.nan)}, "world_mat_1 holds NaN"),
        ({"world_mat_1": np.diag([1.0, 1, 0, 1])}, "world_mat_1 is singular"),
        ({"world_mat_1": np.array([[9.0, 2, 4, 0], [0, 9, 3, 0], [0, 0, 1, 5], [0, 0, 0, 1]])}, "has the skew 2"),
    ],
)
def test_wrong_matrices_are_refused(write, changes, message):
    with pytest.raises(NerfroError, match=message):
        load(write(**changes))


def test_what_is_missing_is_named(write, tmp_path):
    with pytest.raises(NerfroError, match=r"image is not a folder; it should hold the images"):
        load(tmp_path)
    root = write()
    with pytest.raises(NerfroError, match=r"cameras_large\.npz does not exist; name the file of matrices"):
        load(root, cameras="cameras_large.npz")
    (root / "mask/002.png").unlink()
    with pytest.raises(NerfroError, match="holds 4 masks for 5 images"):
        load(root)
    (root / "cameras_sphere.npz").write_bytes(b"PK\3\4 cut off")
    (root / "mask/002.png").write_bytes(b"")
    with pytest.raises(NerfroError, match=r"cameras_sphere\.npz is not a readable \.npz"):
        load(root)
