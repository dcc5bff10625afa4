"""The up direction from handheld cameras and from axes of glasses."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from nerfro.core.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.upright import body_axis, camera_up, find_up
from tests.cameras_at import cameras_at, upright_cameras

TURN = trimesh.transformations.rotation_matrix(1.1, [0.3, -0.9, 0.4])[:3, :3]  # of the world
UP = TURN[:, 2]


def _cameras(roll: float = 0.05, level: bool = True) -> Cameras:
    """Around the origin, 10 to 50 degrees above it, each rolled by a random angle (radians); or tumbled."""
    random = np.random.default_rng(0)
    angles = random.normal(0, roll, 24) if level else random.uniform(0, 6, 24)
    return upright_cameras(24, 40, 50.0, np.degrees(random.uniform(0.2, 0.9, 24)), angles, TURN)


def _glass(tilt: float = 0.0) -> TriangleMesh:
    """Conical, with a step, tilted by so many degrees, somewhere in the turned world."""
    outline = [[0, 0], [0.35, 0], [0.35, 0.2], [0.25, 0.3], [0.5, 1.5], [0, 1.5]]
    body = trimesh.creation.revolve(np.array(outline), sections=64).subdivide_to_size(0.04)
    turned = trimesh.transformations.rotation_matrix(np.radians(tilt), [1, 0, 0])[:3, :3]
    return TriangleMesh(body.vertices @ (TURN @ turned).T + [3.0, -2.0, 1.0], np.asarray(body.faces))


def _degrees(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(first @ second, -1, 1))))


def test_level_cameras_determine_up() -> None:
    up = camera_up(_cameras())
    assert up is not None
    assert _degrees(up, UP) < 2


def test_tumbled_or_coincident_cameras_do_not_determine_up() -> None:
    assert camera_up(_cameras(level=False)) is None
    assert camera_up(_cameras().select([0] * 8)) is None


@pytest.mark.parametrize("tilt", [0.0, 0.03])
def test_cameras_that_look_straight_down_do_not_determine_up(tilt: float) -> None:
    """Their x axes are perpendicular to the vertical line, but nothing says which end of it is up."""
    turns = Rotation.from_euler("z", np.linspace(0, 6, 24)[:, None])
    wobble = Rotation.from_rotvec(np.random.default_rng(0).normal(0, tilt, (24, 3)))
    back = (wobble * turns).as_matrix()
    assert camera_up(cameras_at(np.concatenate([back, 3 * back[:, :, 2:]], -1), 40, 40, 50.0)) is None


@pytest.mark.parametrize("tilt", [0.0, 6.0])
def test_axis_of_a_glass_is_found_from_an_approximate_direction(tilt: float) -> None:
    expected = TURN @ [0, -np.sin(np.radians(tilt)), np.cos(np.radians(tilt))]
    axis = body_axis(_glass(tilt), UP)
    assert axis is not None
    assert _degrees(axis, expected) < 0.2


def test_axis_of_the_body_is_up_if_the_cameras_agree() -> None:
    found = find_up(_cameras(roll=0.08), _glass())
    assert found is not None
    assert _degrees(found[0], UP) < 0.2
    leaning = find_up(_cameras(), _glass(tilt=25))
    assert leaning is not None
    assert "cameras" in leaning[1]
    assert _degrees(leaning[0], UP) < 2
