"""Helpers of the tests of calibration: photographs of printed sheets from known cameras."""

from collections.abc import Sequence

import cv2
import numpy as np

from nerfro.core.light import to_linear, to_srgb
from nerfro.poses.boards import Sheet

_SAMPLES = 3  # per pixel and side
_TO_CENTRES = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixel coordinates


def look_at(centre: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """[R | centre] with OpenCV's axes of a camera that looks at a point, z upwards but for the roll."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return np.column_stack([np.stack([right, np.cross(forward, right), forward], 1) @ turn, centre])


def around(
    sheets: Sequence[Sheet], count: int, distance: float, generator: np.random.Generator, turn: float = 2.4
) -> list[np.ndarray]:
    """Poses above sheets, `distance` times as far away as they are wide."""
    corners = np.concatenate([sheet.corners for sheet in sheets])
    middle, extent = corners.mean(0), np.ptp(corners, axis=0).max()
    poses = []
    for view in range(count):
        azimuth, height = turn * view, generator.uniform(0.6, 1.2)
        towards = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        aim = middle + extent * generator.normal(0, 0.03, 3)
        away = distance * extent * generator.uniform(0.9, 1.2)
        poses.append(look_at(middle + away * towards, aim, generator.normal(0, 0.2)))
    return poses


def photograph(
    sheets: Sequence[Sheet],
    matrix: np.ndarray,
    pose: np.ndarray,
    size: tuple[int, int],
    generator: np.random.Generator,
) -> np.ndarray:
    """Sheets before a grey wall, the far ones first, with noise; grey levels [H, W] of the light on each pixel."""
    picture = np.full((size[1] * _SAMPLES, size[0] * _SAMPLES), to_linear(np.array(150 / 255)), np.float32)
    # The walls of the twelve faces stand on the others.
    for sheet in sorted(sheets, key=lambda one: (np.ptp(one.corners[:, 2]) > 0, -_distance(one, pose))):
        normal = np.cross(sheet.corners[1] - sheet.corners[0], sheet.corners[0] - sheet.corners[3])
        if normal @ (pose[:, 3] - sheet.corners[0]) <= 0:
            continue
        levels = np.kron(sheet.levels, np.ones((8, 8) if sheet.levels.shape[0] < 200 else (1, 1), np.uint8))
        height, width = levels.shape
        seen = (sheet.corners - pose[:, 3]) @ pose[:, :3] @ matrix.T
        corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
        warp = cv2.getPerspectiveTransform(corners, np.float32(seen[:, :2] / seen[:, 2:]))
        warp = _TO_CENTRES @ np.diag([_SAMPLES, _SAMPLES, 1.0]) @ warp @ np.linalg.inv(_TO_CENTRES)
        printed = np.float32(to_linear((20 + 0.85 * levels) / 255))
        drawn = cv2.warpPerspective(printed, warp, picture.shape[::-1])
        covered = cv2.warpPerspective(np.full_like(levels, 255), warp, picture.shape[::-1]) == 255
        picture[covered] = drawn[covered]
    levels = 255 * to_srgb(picture.reshape(size[1], _SAMPLES, size[0], _SAMPLES).mean((1, 3)))
    return np.uint8(np.rint(np.clip(levels + generator.normal(0, 2, levels.shape), 0, 255)))


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Between two rotations, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(one[:, :3].T @ other[:, :3]) - 1) / 2, -1, 1))))


def _distance(sheet: Sheet, pose: np.ndarray) -> float:
    return float(np.linalg.norm(sheet.corners.mean(0) - pose[:, 3]))
