"""Helpers of the tests of data formats: cameras with an independent projection."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from nerfro.data.base import Views

WIDTH, HEIGHT = 24, 18
FX, FY, CX, CY = 31.0, 29.0, 12.7, 8.6
POINTS = np.random.default_rng(5).uniform(-0.4, 0.4, (40, 3))
FLIP = np.diag([1.0, -1.0, -1.0])


def world_to_camera(seed: int) -> np.ndarray:
    """[R | t] with OpenCV axes of a camera at distance 3 that looks at about the origin, rolled at random."""
    generator = np.random.default_rng(seed)
    centre = generator.normal(size=3)
    centre *= 3 / np.linalg.norm(centre)
    forward = -centre / 3
    right = np.cross(forward, generator.normal(size=3))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation = Rotation.from_rotvec(generator.normal(size=3) * 0.03).as_matrix() @ rotation
    return np.column_stack([rotation, -rotation @ centre])


def camera_to_world(seed: int, axes: str) -> np.ndarray:
    """The same camera as a 4x4 camera-to-world matrix, with OpenGL or OpenCV axes."""
    pose = np.linalg.inv(np.vstack([world_to_camera(seed), [0, 0, 0, 1]]))
    if axes == "opengl":
        pose[:3, :3] = pose[:3, :3] @ FLIP
    return pose


def project(seed: int, points: np.ndarray = POINTS, lens=(FX, FY, CX, CY), k=(), p=(0.0, 0.0)) -> np.ndarray:
    """Pixel coordinates (whole numbers at the corners) of points, by the textbook formula."""
    x, y, z = world_to_camera(seed) @ np.c_[points, np.ones(len(points))].T
    assert (z > 0).all()
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k))
    u = x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    v = y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y
    return np.stack([lens[0] * u + lens[2], lens[1] * v + lens[3]], -1)


def picture(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed + 100).integers(0, 256, (height, width, 3), dtype=np.uint8)


def save_picture(path: Path, seed: int, width: int = WIDTH, height: int = HEIGHT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seed, width, height)).save(path)


def save_mask(path: Path, seed: int, width: int = WIDTH, height: int = HEIGHT) -> None:
    """White where the picture's red is above the middle."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.uint8(255 * (picture(seed, width, height)[..., 0] > 127))).save(path)


def check_views(views: Views, seeds: list[int], points: np.ndarray = POINTS, **lens) -> None:
    """Images are those of the seeds, points project where they should, and rays lead back to them."""
    assert len(views) == len(views.cameras) == len(seeds)
    pixels, depth = views.cameras.project(torch.from_numpy(points).float())
    assert (depth > 0).all()
    for view, seed in enumerate(seeds):
        np.testing.assert_array_equal(np.round(255 * views.images[view].numpy()), picture(seed))
        expected = project(seed, points, **lens)
        np.testing.assert_allclose(pixels[view].double().numpy(), expected, atol=1e-4)
        if views.masks is not None:
            np.testing.assert_array_equal(views.masks[view].numpy(), picture(seed)[..., 0] > 127)
        # A ray through the very place in the pixel passes through the point.
        place = torch.from_numpy(expected).float()
        column, row = place.floor().long().unbind(-1)
        rays = views.cameras.rays(torch.full_like(row, view), row, column, place - place.floor())
        assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(len(points)), atol=1e-6)
        offset = torch.from_numpy(points).float() - rays.origins
        away = torch.linalg.cross(offset, rays.directions).norm(dim=-1)
        assert away.max() < 2e-5
