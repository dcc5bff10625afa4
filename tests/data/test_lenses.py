"""Keys of the lens in transforms files, and lenses that every format refuses."""

import math
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from nerfro.camera.base import CameraModel
from nerfro.core.lens import coefficients, opencv_coefficients
from nerfro.data.formats.transforms import BlenderData, NerfstudioData
from nerfro.data.lenses import Lens, check_lenses, read_lens
from nerfro.viewing.camera_paths import write_cameras
from tests.conftest import refused

from .formats import (
    ANGLE,
    CAM_MAT,
    DISTORTION,
    FORMATS,
    SHARED,
    TRAIN,
    K,
    P,
    write_opencv,
    write_transforms,
)
from .photographs import CX, CY, FX, FY, HEIGHT, WIDTH, check_views

SIZE = (WIDTH, HEIGHT)
CENTRE = (WIDTH / 2, HEIGHT / 2)
WIDE = {"camera_angle_x": math.pi / 2}  # focal length 12


@pytest.mark.parametrize(
    ("file", "frame", "expected"),
    [
        # A frame takes precedence over the file, and within one of them a focal length over an angle.
        ({"fl_x": 40, **WIDE}, {}, (40, 40, *CENTRE)),
        ({"fl_x": 40}, WIDE, (12, 12, *CENTRE)),
        ({"fl_x": 40, "fl_y": 38}, WIDE, (12, 12, *CENTRE)),
        ({"fl_x": 40, "fl_y": 38}, {"fl_x": 41}, (41, 38, *CENTRE)),
        ({"fl_x": 40, "fl_y": 38, "cx": 1, "cy": 2}, {"cy": 3}, (40, 38, 1, 3)),
        (WIDE | {"camera_angle_y": math.pi / 2}, {}, (12, 9, *CENTRE)),
        ({"camera_angle_y": math.pi / 2}, {}, (9, 9, *CENTRE)),
        ({"x_fov": 90, "y_fov": 90}, {}, (12, 9, *CENTRE)),
        ({"cam_mat": CAM_MAT}, {}, (FX, FY, CX, CY)),
        (WIDE, {"cam_mat": CAM_MAT}, (FX, FY, CX, CY)),
        ({"cam_mat": CAM_MAT, "w": 2 * WIDTH, "h": 2 * HEIGHT}, {}, (FX / 2, FY / 2, CX / 2, CY / 2)),
        ({"fl_x": 40, "w": 2 * WIDTH, "h": 2 * HEIGHT}, {"w": WIDTH, "h": HEIGHT}, (40, 40, *CENTRE)),
        ({"fl_x": None, **WIDE}, {"cam_mat": None}, (12, 12, *CENTRE)),
        (WIDE | {"is_fisheye": False, "ortho": 0, "sk_x": 0.0, "camera_model": "pinhole"}, {}, (12, 12, *CENTRE)),
    ],
)
def test_frame_keys_and_focal_lengths_have_precedence(file: dict, frame: dict, expected: tuple[float, ...]) -> None:
    lens = read_lens(file, frame, SIZE, "it")
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx(expected)
    assert lens.distortion is None


def test_contradicting_focal_length_and_angle_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    for file, is_named in (({"fl_x": 12.1, **WIDE}, False), ({"fl_x": 13, "x_fov": 90}, True)):
        read_lens(file, {}, SIZE, "it")
        assert ("fl_x=13 contradicts camera_angle_x=1.5708, with which 24" in capsys.readouterr().out) == is_named


@pytest.mark.parametrize(
    ("file", "frame", "expected"),
    [
        (DISTORTION, {}, coefficients(K, P)),
        (DISTORTION, {"k1": 0.1, "k4": 0}, coefficients([0.1, *K[1:3]], P)),
        ({"dist": [0.1, 0.2, 0.3, 0.4, 0.5]}, {}, opencv_coefficients([0.1, 0.2, 0.3, 0.4, 0.5])),
        ({"dist": [[1, 2, 3, 4, 5, 6, 7, 8]]}, {}, opencv_coefficients([1, 2, 3, 4, 5, 6, 7, 8])),
        ({"k1": 0.1}, {"dist": [1, 2, 3, 4]}, opencv_coefficients([1, 2, 3, 4])),
        (
            {"camera_model": "FULL_OPENCV", "k1": 1, "k2": 2, "p1": 3, "p2": 4, "k3": 5, "k4": 6, "k5": 7, "k6": 8},
            {},
            opencv_coefficients([1, 2, 3, 4, 5, 6, 7, 8]),
        ),
    ],
)
def test_distortion_is_read_in_the_conventions_of_nerfstudio_and_opencv(file: dict, frame: dict, expected: Any) -> None:
    assert read_lens(WIDE | file, frame, SIZE, "it").distortion == pytest.approx(expected)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"is_fisheye": True}, "is_fisheye=True is not supported; undistort the images"),
        ({"ortho": True}, "ortho=True is not supported"),
        ({"sk_x": 0.5}, "sk_x"),
        ({"K": CAM_MAT}, "K="),
        ({"focal_length": 35}, "focal_length=35 is not supported; .* state a perspective lens by fl_x"),
        ({"lens": "fisheye"}, "lens='fisheye' is not supported"),
        ({"FL_X": 40}, "FL_X=40"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model='OPENCV_FISHEYE' is not supported; undistort"),
        ({"camera_type": "equirectangular"}, "camera_type='equirectangular' is not supported"),
        ({"fl_x": True}, "fl_x=True is not allowed"),
        ({"fl_x": "long"}, "fl_x='long' is not allowed"),
        ({"k1": math.nan}, "k1=nan is not allowed; take a finite number"),
        ({"cx": 0.5, "cy": 0.52}, "cx=0.5 and cy=0.52 seem to be fractions; give pixels"),
        ({"k5": 0.1}, "k5 and k6 belong to OpenCV's rational model"),
        ({"cam_mat": CAM_MAT, "fl_x": 31}, "cam_mat and fl_x both state the lens; keep one"),
        ({"dist": [0.1, 0, 0, 0], "k1": 0.1}, "dist and k1 both state the lens"),
    ],
)
@pytest.mark.parametrize("place", ["file", "frame"])
def test_keys_of_other_projections_are_refused(place: str, keys: dict, message: str) -> None:
    file, frame = (WIDE | keys, {}) if place == "file" else (WIDE, keys)
    refused(rf"^it: .*{message}", read_lens, file, frame, SIZE, "it")


def test_intrinsics_in_blender_files_are_read(tmp_path: Path) -> None:
    root = write_transforms(tmp_path, {"camera_angle_x": ANGLE} | SHARED | DISTORTION)
    check_views(BlenderData(str(root)).load("train"), list(TRAIN), k=K, p=P)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (
            Lens(0.2, 29, CX, CY),
            "a: the lens, for an image of 24x18 pixels, has fx=0.2 is not allowed; take at",
        ),
        (Lens(24_001, 29, CX, CY), "fx=24001 is not allowed"),
        (Lens(math.nan, 29, CX, CY), "fx=nan is not allowed"),
        (Lens(FX, -29, CX, CY), "fy / fx=-0.9"),
        (Lens(FX, 5 * FX, CX, CY), "fy / fx=5.0 is not allowed; take at least 0.25 and at most 4"),
        (Lens(FX, FY, 200, CY), "cx=200 is not allowed; take at least -120 and at most 144"),
        (Lens(FX, FY, CX, -math.inf), "cy=-inf is not allowed"),
        (Lens(FX, FY, CX, CY, coefficients([-9.0])), "a: the lens distortion is not invertible everywhere"),
        (Lens(FX, FY, CX, CY, coefficients([1e30])), "a: the lens distortion is not invertible everywhere"),
        (Lens(FX, FY, CX, CY, coefficients([math.nan])), "a: the lens distortion is not invertible everywhere"),
    ],
)
def test_impossible_lenses_are_refused(lens: Lens, message: str) -> None:
    refused(message, check_lenses, [Lens(FX, FY, CX, CY), lens], ["b", "a"], SIZE)


def test_principal_points_outside_the_image_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    check_lenses([Lens(FX, FY, CX, CY), Lens(FX, FY, WIDTH + 1, CY)], ["a", "b"], SIZE)
    assert "the principal point lies outside the image: b;" in capsys.readouterr().out


@pytest.mark.parametrize("dist", [[0.1, -0.02, 0.001, 0.002, 0.003], [0.4, 0.05, 0.001, -0.002, 0.002, 0.6, 0.1, 0.01]])
def test_written_cameras_keep_their_distortion(tmp_path: Path, dist: list[float]) -> None:
    views = FORMATS["opencv"].load(write_opencv(tmp_path, dist=dist))
    camera: Any = Mock(spec=CameraModel, moves=True, exposure=None, estimated=lambda cameras: cameras)
    write_cameras(tmp_path / "transforms.json", camera, views)
    read = NerfstudioData(str(tmp_path), near=0.5, far=9.0, test_every=2).load("train").cameras.distortion
    np.testing.assert_allclose(read, views.cameras.distortion[1::2], rtol=1e-5)
