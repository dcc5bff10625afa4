"""Camera poses around the object."""

from __future__ import annotations

import numpy as np
import trimesh

from nerfro.scenes.distance import Vector


def directions_on_sphere(count: int, seed: int, split: int) -> np.ndarray:
    """Return well-spread unit directions [count, 3]: a Fibonacci lattice, turned at random and jittered.

    Each `split` of the data set of a `seed` gets its own rotation, so no test view repeats a training view.
    """
    generator = np.random.default_rng([seed, split])
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    phi = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    lattice = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1)
    turn = trimesh.transformations.random_rotation_matrix(generator.random(3))[:3, :3]
    spacing = np.sqrt(4 * np.pi / count)
    jittered = lattice @ turn.T + 0.2 * spacing * generator.normal(size=lattice.shape)
    jittered = jittered / np.linalg.norm(jittered, axis=1, keepdims=True)
    return generator.permutation(jittered)


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


def hand_held(
    count: int, seed: int, target: Vector, distance: float, elevations: tuple[float, float], laps: int
) -> list[np.ndarray]:
    """Return the poses of a photographer who climbs around the object in `laps` laps, none of them exactly.

    Args:
        count: number of photographs.
        seed: of what is not exact: direction, distance and aim (some per cent), and roll (6 degrees).
        target: what the camera looks at, world units.
        distance: of the camera from the target.
        elevations: lowest and highest above the target, degrees; equal areas in between get equally many photographs.
        laps: number of times around.

    Returns:
        Camera-to-world matrices [4, 4], OpenGL axes, in the order in which they are taken.
    """
    generator = np.random.default_rng(seed)
    low, high = np.sin(np.radians(elevations))
    poses = []
    for index in range(count):
        share = (index + 0.5) / count
        azimuth = 2 * np.pi * (laps * share + 0.02 * generator.normal())
        height = np.clip(low + (high - low) * (share + 0.03 * generator.normal()), low, high)
        level = np.sqrt(1 - height**2)
        direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), height])
        pose = look_at_origin(distance * generator.uniform(0.95, 1.05) * direction)
        pose[:3, 3] += np.asarray(target) + 0.02 * distance * generator.uniform(-1, 1, 3)
        roll = np.radians(6.0) * generator.uniform(-1, 1)
        right, up = pose[:3, 0].copy(), pose[:3, 1].copy()
        pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * up
        pose[:3, 1] = np.cos(roll) * up - np.sin(roll) * right
        poses.append(pose)
    return poses
