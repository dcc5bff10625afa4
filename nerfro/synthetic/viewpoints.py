"""Camera poses around the object."""

from __future__ import annotations

import numpy as np
import trimesh

from nerfro.geometry.normals import fibonacci_lattice


def directions_on_sphere(count: int, seed: int, split: int) -> np.ndarray:
    """Return well-spread unit directions [count, 3]: a Fibonacci lattice, turned at random and jittered.

    Each `split` of the data set of a `seed` gets its own rotation, so no test view repeats a training view.
    """
    generator = np.random.default_rng([seed, split])
    lattice = fibonacci_lattice(count)
    turn = trimesh.transformations.random_rotation_matrix(generator.random(3))[:3, :3]
    spacing = np.sqrt(4 * np.pi / count)
    jittered = lattice @ turn.T + 0.2 * spacing * generator.normal(size=lattice.shape)
    jittered = jittered / np.linalg.norm(jittered, axis=1, keepdims=True)
    return generator.permutation(jittered)


def directions_on_ring(count: int, seed: int, split: int, elevation: float = 25.0) -> np.ndarray:
    """Return evenly spaced unit directions [count, 3] at an elevation in degrees, from a random azimuth per split."""
    turn = np.random.default_rng([seed, split]).random()
    phi, theta = 2 * np.pi * (np.arange(count) + turn) / count, np.radians(elevation)
    return np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.full(count, np.sin(theta))], -1)


def look_at_origin(position: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] (OpenGL axes: x right, y up, looks along -z) of a camera at `position`.

    World z is up in the image, except directly above and below the origin, where world y is up.
    """
    backward = position / np.linalg.norm(position)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(backward, right), backward, position], -1)
    return pose
