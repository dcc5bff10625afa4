"""Cameras for tests: at given or random poses, with one lens."""

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerfro.core.cameras import Cameras


def cameras_at(
    poses: np.ndarray | Tensor, width: int, height: int, fx: float, fy: float | None = None,
    cx: float | None = None, cy: float | None = None, near: float = 2.0, far: float = 6.0,
) -> Cameras:  # fmt: skip
    """Cameras at camera-to-world matrices [V, 3, 4]; by default pixels are square and the lens is centred."""
    lens = fx, fy or fx, cx or width / 2, cy or height / 2
    each = (torch.full((len(poses),), float(value)) for value in lens)
    return Cameras(torch.as_tensor(poses).float(), *each, width, height, near, far)


def random_poses(count: int) -> np.ndarray:
    """Camera-to-world matrices [V, 3, 4] with any orientation, beside the origin."""
    turns, places = Rotation.random(count, random_state=0).as_matrix(), np.random.default_rng(0).normal(size=(count, 3))
    return np.concatenate([turns, places[..., None]], -1)


def upright_cameras(
    count: int, size: int, focal: float, elevation: ArrayLike = 30.0, roll: ArrayLike = 0.0,
    world: np.ndarray | None = None, **bounds: float,
) -> Cameras:  # fmt: skip
    """Cameras at equal angles around the z axis that look at the origin from a distance of 4.

    Args:
        count: number of cameras.
        size: pixels per side of the image.
        focal: focal length in pixels.
        elevation: angle above the xy plane, degrees; of all cameras or of each.
        roll: angle by which a camera rotates about its viewing direction, radians; of all cameras or of each.
        world: rotation [3, 3] of the cameras about the origin.
        bounds: `near` and `far`.
    """
    azimuth, raised = 2 * np.pi * np.arange(count) / count, np.radians(np.broadcast_to(elevation, count))
    flat = np.cos(raised)
    poses = poses_towards_origin(np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(raised)], -1), 4.0)
    poses[..., :3] @= Rotation.from_euler("z", np.broadcast_to(roll, count)[:, None]).as_matrix()
    return cameras_at(poses if world is None else world @ poses, size, size, focal, **bounds)


def poses_towards_origin(
    directions: np.ndarray, distance: float, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """Camera-to-world matrices [V, 3, 4] of cameras in the unit directions [V, 3] that look at the origin."""
    right = np.cross(up, directions)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(directions, right), directions, distance * directions], -1)
