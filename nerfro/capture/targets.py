"""Calibration targets: their known points found in a photograph, and their sheets for printing."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nerfro.capture.boards import TagBoard, tag_detector
from nerfro.errors import NerfroError


@dataclass(frozen=True)
class Sighting:
    """Points of a target seen in one image.

    Attributes:
        features: number of the tag or corner that each point belongs to.
        points: in the target's frame and unit.
        pixels: (column, row), whole numbers at the pixels' corners.
    """

    features: Int[np.ndarray, "N"]
    points: Float[np.ndarray, "N 3"]
    pixels: Float[np.ndarray, "N 2"]

    def only(self, chosen: Bool[np.ndarray, "N"]) -> Sighting:
        """Some of the points."""
        return Sighting(self.features[chosen], self.points[chosen], self.pixels[chosen])

    @property
    def num_features(self) -> int:
        return len(np.unique(self.features))


@dataclass(frozen=True)
class Sheet:
    """One printed page of a target.

    Attributes:
        title: what it is and where it goes.
        levels: 0 black to 255 white.
        corners: upper left, upper right, lower right, lower left in the target's frame and unit.
    """

    title: str
    levels: UInt8[np.ndarray, "H W"]
    corners: Float[np.ndarray, "4 3"]


class Target(ABC):
    """Something flat or folded that is printed, laid into the scene, and found in the photographs.

    Attributes:
        feature: what is counted, in the plural.
        fewest: an image with fewer of them is skipped.
    """

    feature: str
    fewest: int

    @abstractmethod
    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        """The target's points in a grey image."""

    @abstractmethod
    def sheets(self) -> list[Sheet]:
        """What is printed."""


class TagTarget(Target):
    """A board of AprilTags."""

    # As the paper's authors: twelve corners.
    feature, fewest = "tags", 3

    def __init__(self, board: TagBoard) -> None:
        self.board, self.corners = board, board.tag_corners()

    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        # The library counts pixels from the image's corner as nerfro does, and goes round the tag from its lower left.
        tags = [tag for tag in tag_detector(self.board.family).detect(image) if tag.tag_id in self.corners]
        repeated = {tag.tag_id for tag in tags if sum(other.tag_id == tag.tag_id for other in tags) > 1}
        tags = [tag for tag in tags if tag.tag_id not in repeated]  # one of them is a reflection, or misread
        return Sighting(
            np.repeat(np.array([tag.tag_id for tag in tags], int), 4),
            np.concatenate([np.empty((0, 3)), *(self.corners[tag.tag_id] for tag in tags)]),
            np.concatenate([np.empty((0, 2)), *(tag.corners[::-1] for tag in tags)]),
        )

    def sheets(self) -> list[Sheet]:
        return [
            Sheet(
                f"face {number} (tags {face.ids.min()} to {face.ids.max()}), its front towards {_towards(face)}",
                self.board.draw(face),
                self.board.face_corners(face),
            )
            for number, face in enumerate(self.board.faces)
        ]


class CharucoTarget(Target):
    """A chessboard with ArUco markers on its white squares, on one sheet in the plane z = 0, y to its top.

    Args:
        columns, rows: number of squares.
        square, marker: sides, in the unit of the poses.
        dictionary: of the markers, as OpenCV calls it without DICT_.

    Raises:
        NerfroError: OpenCV is not installed, or has no such dictionary or board.
    """

    feature, fewest = "chessboard corners", 6

    def __init__(self, columns: int, rows: int, square: float, marker: float, dictionary: str) -> None:
        cv2 = opencv()
        number = getattr(cv2.aruco, f"DICT_{dictionary}", None)
        if number is None:
            known = sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise NerfroError(f"there is no dictionary={dictionary}; OpenCV has {', '.join(known)}")
        if min(columns, rows) < 3 or not 0 < marker < square:
            raise NerfroError(
                f"columns={columns}, rows={rows}, size={square}, marker={marker} are no ChArUco board; take 3 or more "
                "squares a side, and markers that are smaller than the squares"
            )
        self.columns, self.rows, self.square = columns, rows, square
        try:
            self.board = cv2.aruco.CharucoBoard(
                (columns, rows), square, marker, cv2.aruco.getPredefinedDictionary(number)
            )
            self.detector = cv2.aruco.CharucoDetector(self.board)
        except cv2.error as error:
            raise NerfroError(
                f"dictionary={dictionary} has too few markers for {columns}x{rows} squares; take a larger one"
            ) from error

    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        corners, numbers, _, _ = self.detector.detectBoard(image)
        if numbers is None:
            return Sighting(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2)))
        numbers = np.asarray(numbers).reshape(-1)
        # OpenCV's pixel centres are whole numbers, and its board has y downwards.
        points = np.asarray(self.board.getChessboardCorners(), np.float64)[numbers]
        points = np.column_stack([points[:, 0], self.rows * self.square - points[:, 1], np.zeros(len(points))])
        return Sighting(numbers, points, np.asarray(corners, np.float64).reshape(-1, 2) + 0.5)

    def sheets(self) -> list[Sheet]:
        pixels = 64  # per square
        levels = self.board.generateImage((self.columns * pixels, self.rows * pixels), marginSize=0)
        right, top = self.columns * self.square, self.rows * self.square
        corners = np.array([[0, top, 0], [right, top, 0], [right, 0, 0], [0, 0, 0]])
        return [Sheet(f"ChArUco board, {self.columns}x{self.rows} squares", np.asarray(levels), corners)]


@functools.cache
def opencv() -> ModuleType:
    """OpenCV.

    Raises:
        NerfroError: it is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise NerfroError(
            f"this needs OpenCV ({error}); pip install 'nerfro[capture]', or opencv-python-headless"
        ) from error
    return cv2


def _towards(face: Any) -> str:
    normal = np.cross(face.down, face.right)
    axis = int(np.abs(normal).argmax())
    return f"{'+' if normal[axis] > 0 else '-'}{'xyz'[axis]}"
