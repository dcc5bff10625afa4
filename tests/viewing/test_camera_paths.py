"""Camera paths around an object, and camera paths of other programs."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from nerfro.viewing.camera_paths import (
    PATHS,
    CaptureGeometry,
    OrbitPosition,
    between_keys,
    cameras_of_file,
    path_cameras,
    read_cameras,
)
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import refused
from tests.data.formats import FORMATS
from tests.data.photographs import HEIGHT, WIDTH

CENTRE = torch.tensor([0.5, -0.2, 0.1])


@pytest.fixture
def around(scene: TrainedScene) -> CaptureGeometry:
    return CaptureGeometry.of(scene.cameras("train"), torch.stack([CENTRE - 1, CENTRE + 1]))


@pytest.mark.parametrize("name", sorted(PATHS))
def test_all_cameras_look_at_the_centre_upright(name: str, around: CaptureGeometry) -> None:
    cameras = path_cameras(around, name, OrbitPosition(30, 20, 5.0), 16)
    pixels, depth = cameras.project(CENTRE[None])
    torch.testing.assert_close(pixels[:, 0], torch.full((16, 2), 16.0), atol=1e-3, rtol=0)
    assert (depth > 0).all()
    rotation = cameras.camera_to_world[:, :, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).expand(16, 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotation) > 0).all()
    assert (rotation[:, 2, 1] > 0).all(), "the picture's up is the world's"
    torch.testing.assert_close(rotation[:, 2, 0], torch.zeros(16), atol=1e-5, rtol=0)
    # Rays begin before the object and end behind it.
    distances = (cameras.camera_to_world[:, :, 3] - CENTRE).norm(dim=-1)
    assert cameras.near <= distances.min() - around.distance + around.camera.near + 1e-4
    assert cameras.far >= distances.max() - around.distance + around.camera.far - 1e-4


def test_splines_through_key_frames_follow_a_smooth_path(around: CaptureGeometry) -> None:
    keys, dense = (path_cameras(around, "spiral", OrbitPosition(0, 30, 5.0), number) for number in (33, 65))
    keys = replace(
        keys, fx=torch.linspace(40.0, 72.0, 33), distortion=torch.linspace(0, 0.1, 33)[:, None].expand(33, 9)
    )
    between = between_keys(keys, 65)
    torch.testing.assert_close(between.camera_to_world[::2], keys.camera_to_world, atol=1e-5, rtol=0)
    torch.testing.assert_close(between.camera_to_world, dense.camera_to_world, atol=0.01, rtol=0)
    straight = 0.5 * (keys.camera_to_world[1:, :, 3] + keys.camera_to_world[:-1, :, 3])
    assert (straight - dense.camera_to_world[1::2, :, 3]).norm(dim=-1).max() > 0.05, "lines are no substitute"
    torch.testing.assert_close(between.fx, torch.linspace(40.0, 72.0, 65))
    torch.testing.assert_close(between.distortion[1], torch.full((9,), 0.1 / 64))
    refused("frames=9 needs two or more cameras", between_keys, keys.select([0]), 9)


def test_target_is_in_the_centre_of_the_image_although_photographs_are_off_centre(scene: TrainedScene) -> None:
    photographs = scene.cameras("train")
    photographs = replace(photographs, cx=photographs.cx - 11, cy=photographs.cy + 7)
    geometry = CaptureGeometry.of(photographs, torch.stack([CENTRE - 1, CENTRE + 1]))
    target = torch.tensor([0.1, 0.3, -0.2])
    cameras = geometry.look_at(torch.tensor([[3.0, 1.0, 2.0], [-2.0, 3.0, 0.5]]), target)
    torch.testing.assert_close(cameras.project(target[None])[0][:, 0], torch.full((2, 2), 16.0), atol=1e-3, rtol=0)


def test_orbit_is_a_circle_that_does_not_repeat_its_first_camera(around: CaptureGeometry) -> None:
    cameras = path_cameras(around, "orbit", OrbitPosition(0, 30, 5.0), 8)
    offsets = cameras.camera_to_world[:, :, 3] - CENTRE
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((8,), 5.0))
    torch.testing.assert_close(offsets[:, 2], torch.full((8,), 5 * math.sin(math.radians(30))))
    torch.testing.assert_close(offsets.sum(0)[:2], torch.zeros(2), atol=1e-5, rtol=0)
    steps = (offsets.roll(-1, 0) - offsets).norm(dim=-1)
    torch.testing.assert_close(steps, steps[:1].expand(8), atol=1e-5, rtol=0)


def test_dolly_approaches_and_spiral_rises(around: CaptureGeometry) -> None:
    near = path_cameras(around, "dolly", OrbitPosition(0, 0, 4.0), 5).camera_to_world[:, :, 3] - CENTRE
    torch.testing.assert_close(near.norm(dim=-1)[[0, -1]], torch.tensor([6.0, 3.0]))
    heights = (path_cameras(around, "spiral", OrbitPosition(0, 40, 4.0), 9).camera_to_world[:, :, 3] - CENTRE)[:, 2]
    assert (heights.diff() > 0).all()
    torch.testing.assert_close(heights[0], -heights[-1])


@pytest.mark.parametrize("elevation", [90, -90])
def test_orbit_above_or_below_rotates_the_image(elevation: float, around: CaptureGeometry) -> None:
    poses, nearly = (
        path_cameras(around, "orbit", OrbitPosition(10, share * elevation, 5.0), 8).camera_to_world
        for share in (1.0, 0.9999)
    )
    torch.testing.assert_close(poses, nearly, atol=2e-3, rtol=0)
    turns = torch.linalg.cross(poses[:, :, 0], poses.roll(-1, 0)[:, :, 0])[:, 2]
    torch.testing.assert_close(turns, torch.full((8,), math.sin(math.radians(45))))


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
def test_camera_above_its_target_looks_down(up: list[float], around: CaptureGeometry) -> None:
    vertical = torch.nn.functional.normalize(torch.tensor(up), dim=0)
    cameras = replace(around, up=vertical).look_at((CENTRE + 4 * vertical)[None], CENTRE)
    rotation = cameras.camera_to_world[0, :, :3]
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation[:, 2], vertical, atol=1e-5, rtol=0)


def test_up_direction_matches_the_photographs(scene: TrainedScene) -> None:
    cameras = scene.cameras("train")
    turn = torch.tensor([[1.0, 0, 0], [0, 0.0, 1], [0, -1, 0]])  # z to y
    turned = cameras._each(lambda values: turn @ values if values.ndim == 3 else values)
    found = CaptureGeometry.of(turned, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    torch.testing.assert_close(found.up, torch.tensor([0.0, 1.0, 0.0]))


def test_nerfstudios_camera_path_is_read(around: CaptureGeometry, tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.0, 0.0, 4.0])
    places = [{"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": 2} for fov in (40, 60)]
    document = {"camera_type": "perspective", "render_height": 50, "render_width": 100, "camera_path": places}
    (tmp_path / "path.json").write_text(json.dumps(document))
    cameras = read_cameras(tmp_path / "path.json", around)
    assert (cameras.width, cameras.height, len(cameras)) == (100, 50, 2)
    # The top edge is half the vertical field of view above the middle.
    for view, fov in enumerate((40, 60)):
        top = torch.tensor([[0.0, 4 * math.tan(math.radians(fov / 2)), 0.0]])
        pixels, _ = cameras.select([view]).project(top)
        torch.testing.assert_close(pixels[0, 0], torch.tensor([50.0, 0.0]), atol=1e-3, rtol=0)


def test_transforms_are_read_without_their_images(around: CaptureGeometry, tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[2, 3] = 3.0
    frames = [{"file_path": "gone.png", "transform_matrix": pose.tolist()}]
    lens = {"fl_x": 80.0, "fl_y": 82.0, "cx": 31.0, "cy": 17.0, "w": 64, "h": 36}
    for document in ({**lens, "frames": frames}, {"frames": [{**lens, **frames[0]}]}):
        (tmp_path / "transforms.json").write_text(json.dumps(document))
        cameras = read_cameras(tmp_path / "transforms.json", around)
        found = [float(value) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
        assert (found, cameras.width, cameras.height) == ([80, 82, 31, 17], 64, 36)
        torch.testing.assert_close(cameras.camera_to_world[0], pose[:3])


def test_size_without_keys_is_that_of_the_images_or_refused_for_lengths_in_pixels(
    around: CaptureGeometry, tmp_path: Path
) -> None:
    file, pose = tmp_path / "transforms.json", torch.eye(4).tolist()
    document = {"fl_x": 80.0, "frames": [{"file_path": "r_0", "transform_matrix": pose}]}
    file.write_text(json.dumps(document))
    message = "has fl_x in pixels, but neither w and h nor the image of its first frame; add w"
    refused(message, read_cameras, file, around)
    Image.new("RGB", (64, 36)).save(tmp_path / "r_0.png")
    cameras = read_cameras(file, around)
    assert (cameras.width, cameras.height, float(cameras.fx), float(cameras.cx)) == (64, 36, 80, 32)
    file.write_text(json.dumps({"camera_angle_x": 0.5, "frames": [{"transform_matrix": pose}]}))
    assert read_cameras(file, around).width == around.camera.width


@pytest.mark.parametrize("form", ["blender", "opencv", "nerfstudio"])
def test_file_of_the_data_set_gives_its_views(
    form: str, around: CaptureGeometry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    FORMATS[form].write(root := tmp_path / "data")
    source = FORMATS[form].open(root, downscale=2)
    own = next(file for file in sorted(root.glob("transforms*.json")) if file.stem in ("transforms", "transforms_test"))
    copied = Path(shutil.copy(own, tmp_path / "copy.json"))
    views = [source.load(split).cameras for split in (("train", "test") if own.stem == "transforms" else ("test",))]
    for file in (own, copied):
        cameras = cameras_of_file(file, around, source)
        assert f"cameras of {WIDTH // 2}x{HEIGHT // 2} pixels, of the data set" in capsys.readouterr().out
        for name in ("camera_to_world", "fx", "cy"):
            values, expected = getattr(cameras, name), torch.cat([getattr(split, name) for split in views])
            torch.testing.assert_close(values.sort(0).values, expected.sort(0).values)
        assert (cameras.width, cameras.near) == (views[0].width, views[0].near)


def test_cameras_with_other_axes_are_reported(
    around: CaptureGeometry, scene: TrainedScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = torch.cat([scene.cameras("test").camera_to_world, torch.tensor([0, 0, 0, 1.0]).expand(3, 1, 4)], 1)
    for axes, reported in (([1, 1, 1, 1], False), ([1, -1, -1, 1], True)):
        frames = [{"transform_matrix": (pose * torch.tensor(axes)).tolist()} for pose in poses]
        (tmp_path / "other.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
        cameras_of_file(tmp_path / "other.json", around, scene.source)
        lines = capsys.readouterr().out
        assert "3 cameras of 32x32 pixels, with OpenGL axes" in lines
        assert ("look away from the object" in lines) == reported


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({}, "neither 'camera_path' nor 'frames'"),
        ({"camera_path": []}, "has no cameras"),
        ({"camera_path": [{"fov": 40}]}, "camera 0 has no 'camera_to_world'"),
        ({"camera_path": [{"fov": 400, "camera_to_world": torch.eye(4).flatten().tolist()}]}, "fov=400 must be"),
        ({"camera_path": [{"fov": 40, "camera_to_world": [1, 2]}]}, "camera 0 has shape 2"),
        (
            {"frames": [{"transform_matrix": (2 * torch.eye(4)).tolist()}], "fl_x": 3, "w": 4, "h": 4},
            "is not a rotation",
        ),
        ({"frames": [{"transform_matrix": torch.eye(4).tolist()}]}, "has no focal length"),
    ],
)
def test_damaged_cameras_are_refused(document: dict, message: str, around: CaptureGeometry, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(json.dumps(document))
    refused(message, read_cameras, tmp_path / "path.json", around)
