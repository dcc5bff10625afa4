"""Turntables: the object turns before a camera, and the background stands still in the room."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import nerfro
from nerfro.core.cameras import room_rotations
from nerfro.core.types import Exits
from nerfro.data.formats.transforms import BlenderData
from nerfro.samplers.base import straight_path
from nerfro.synthetic.dataset import look_at_origin
from nerfro.training.inputs import INPUTS, inputs_of, recorded_cameras, require_same_inputs
from tests.cameras_at import cameras_at
from tests.conftest import Runner, composed, refused, train_in

AXIS = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])


def turned(degrees: float) -> np.ndarray:
    """Return the rotation about `AXIS`, by the formula of Rodrigues."""
    x, y, z = AXIS
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def poses_on_turntable(in_room: list[np.ndarray], degrees: list[float]) -> np.ndarray:
    """Return poses relative to an object that has turned by some angles before cameras in the room."""
    return np.stack([turned(-angle) @ pose[:3] for pose, angle in zip(in_room, degrees, strict=True)])


def upright_pose(height: float) -> np.ndarray:
    """Return a camera in the plane of `AXIS` and one horizontal direction, upright with respect to the axis."""
    right = np.cross(AXIS, [1.0, 0, 0])
    right /= np.linalg.norm(right)
    back = np.cross(right, AXIS) + height * AXIS
    back /= np.linalg.norm(back)
    return np.stack([right, np.cross(back, right), back, 4 * back], -1)


@pytest.mark.parametrize(("heights", "turntable"), [((0.4, 0.4, 0.4), True), ((0.2, 0.9, -0.3), tuple(AXIS.tolist()))])
def test_same_direction_of_the_room_is_seen_alike_in_all_views(heights, turntable):
    in_room, angles = [upright_pose(height) for height in heights], [0.0, 77.0, 201.0]
    cameras = replace(cameras_at(poses_on_turntable(in_room, angles), 32, 32, 40.0), turntable=turntable)
    rays = cameras.rays(torch.arange(3), torch.tensor([9, 17, 30]), torch.tensor([4, 20, 11]))
    objects = rays.directions.double().numpy()
    # The frames of the room differ by one constant rotation, that of the first view, whose object has not turned.
    seen = straight_path(rays).in_room_of(rays).exits().directions.double().numpy()
    frame = room_rotations(torch.from_numpy(in_room[0])[None], turntable)[0].numpy()
    for view, angle in enumerate(angles):
        np.testing.assert_allclose(seen[view], frame @ turned(angle) @ objects[view], atol=1e-6)
    torch.testing.assert_close(Exits.unbent(rays).directions.double(), torch.from_numpy(seen))


def test_room_has_z_up_and_the_camera_looks_along_negative_x():
    pose = torch.from_numpy(look_at_origin(np.array([1.0, 2.0, 0.0])))[:3]
    for turntable in (True, (0.0, 0.0, 2.0)):
        axes = room_rotations(pose, turntable) @ pose[:, :3]
        torch.testing.assert_close(axes, torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]).double())


@pytest.fixture
def turntable_data(tiny_scene: Path, tmp_path: Path) -> Path:
    """A data set whose files say that the object turns."""
    folder = tmp_path / "data"
    shutil.copytree(tiny_scene, folder)
    for file in folder.glob("transforms_*.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"turntable_axis": [0, 0, 1]}))
    return folder


def test_files_and_setting_state_the_turntable(turntable_data: Path) -> None:
    root = str(turntable_data)
    assert BlenderData(root).load("train").cameras.turntable == (0.0, 0.0, 1.0)
    assert BlenderData(root, turntable=False).load("train").cameras.turntable is False
    assert BlenderData(root, turntable=True).load("test").cameras.turntable is True
    refused("is no axis", BlenderData, root, turntable_axis=[0, 0, 0])
    poses = BlenderData(root).load("train").cameras.camera_to_world
    sideways = poses[0, :, 0].tolist()
    refused("parallel to the axis", BlenderData(root, turntable_axis=sideways).load, "train")


def test_splits_that_disagree_are_refused(turntable_data: Path) -> None:
    file = turntable_data / "transforms_test.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"turntable_axis": [0, 1, 0]}))
    refused("have other values of turntable or turntable_axis", BlenderData(str(turntable_data)).load, "train")


@pytest.mark.parametrize("turntable", [True, False, (0.0, 0.0, 1.0)])
def test_checkpoint_knows_the_turntable(turntable_data: Path, turntable, tmp_path: Path) -> None:
    config = composed()
    views = BlenderData(str(turntable_data), turntable=False).load("train")
    views = replace(views, cameras=replace(views.cameras, turntable=turntable))
    checkpoint = {INPUTS: inputs_of(config, views)}
    assert recorded_cameras(checkpoint).turntable == turntable
    require_same_inputs(checkpoint, tmp_path, config, views)
    changed = replace(views, cameras=replace(views.cameras, turntable=(1.0, 0.0, 0.0)))
    refused("other photographs or cameras", require_same_inputs, checkpoint, tmp_path, config, changed)


@pytest.mark.slow
def test_run_renders_with_the_object_turning(turntable_data: Path, tiny_default_run: list[str], tmp_path: Path) -> None:
    run = train_in(tmp_path / "run", *tiny_default_run, f"data.root={turntable_data}", "trainer.max_steps=2")
    scene = nerfro.load(run)
    cameras = scene.cameras("train")
    assert cameras.turntable == (0.0, 0.0, 1.0)
    # Rays that miss the object show the same part of the room after a turn of the object by any angle.
    pose = torch.from_numpy(look_at_origin(np.array([3.0, 1.0, 1.0])))[:3].float()
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    both = replace(cameras.select([0, 0]), camera_to_world=torch.stack([pose, turn @ pose]))
    with torch.no_grad():
        scene.renderer.scene.background.texels.normal_()
    first, second = scene.with_(glass=False, inside=False).render(both).rgb
    torch.testing.assert_close(first, second, atol=1e-4, rtol=0)
    assert first.std() > 0.01
    page = nerfro.export(run, what="page", out=tmp_path / "page.html")
    assert '"turntable": [0, 0, 1]' in page.read_text()
    assert "the room behind it stands still" in page.read_text()


def test_components_of_a_fixed_background_are_refused(
    turntable_data: Path, tiny_default_run: list[str], train_here: Runner
) -> None:
    options = [*tiny_default_run, f"data.root={turntable_data}", "trainer.max_steps=2"]
    assert "camera=refined needs a fixed background" in train_here(*options, "camera=refined", code=1).error
    assert "content.space=all makes surroundings" in train_here(*options, "content.space=all", code=1).error
