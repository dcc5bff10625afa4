"""Cameras for tests: at given or random poses, with one lens."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerfro.cameras import Cameras


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
