"""AprilTag boards: where each tag's corners are, and what its faces look like in print.

A board has its own right-handed frame and unit. A face is a sheet: tags side by side, seen from its front.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from nerfro.errors import NerfroError

Family = Literal["tag36h11", "tagStandard41h12"]


class Layout(NamedTuple):
    """What a tag of a family measures, in modules (the squares that it is made of)."""

    side: int  # of a whole tag, with the white border of tag36h11
    inset: int  # of the corners that are detected, from the whole tag's sides


LAYOUTS: dict[Family, Layout] = {"tag36h11": Layout(10, 1), "tagStandard41h12": Layout(9, 2)}


@dataclass(frozen=True)
class Face:
    """A sheet of tags in space.

    Attributes:
        origin: its upper left corner as printed, board units.
        right, down: unit vectors along its upper and its left edge; it is seen from where `down` turns to `right`
            anticlockwise.
        ids: of its tags as printed, rows from above.
    """

    origin: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    ids: Int[np.ndarray, "rows columns"]

    @property
    def front(self) -> str:
        """The axis that its front looks along, as in +x."""
        normal = np.cross(self.down, self.right)
        axis = int(np.abs(normal).argmax())
        return f"{'+' if normal[axis] > 0 else '-'}{'xyz'[axis]}"


@dataclass(frozen=True)
class TagBoard:
    """AprilTags of modules of a side in board units, on one or several faces."""

    family: Family
    module: float
    faces: tuple[Face, ...]

    def tag_corners(self) -> dict[int, Float[np.ndarray, "4 3"]]:
        """The corners that are detected of each tag by its id: upper left, upper right, lower right, lower left."""
        side, inset = LAYOUTS[self.family]
        near, far = inset * self.module, (side - inset) * self.module
        first = np.array([[near, near], [far, near], [far, far], [near, far]])
        return {
            int(number): _on_face(face, first + side * self.module * np.array([column, row]))
            for face in self.faces
            for (row, column), number in np.ndenumerate(face.ids)
        }

    def face_corners(self, face: Face) -> Float[np.ndarray, "4 3"]:
        """The corners of a whole sheet: upper left, upper right, lower right, lower left."""
        rows, columns = face.ids.shape
        height, width = (LAYOUTS[self.family].side * self.module * count for count in (rows, columns))
        return _on_face(face, np.array([[0, 0], [width, 0], [width, height], [0, height]]))

    def draw(self, face: Face, module_pixels: int = 1) -> UInt8[np.ndarray, "H W"]:
        """A sheet as printed, without a margin: 0 is black, 255 white."""
        sheet = np.block([[draw_tag(self.family, int(number)) for number in row] for row in face.ids])
        return np.kron(sheet, np.ones((module_pixels, module_pixels), np.uint8))


def twelve_faces(tag: float = 0.05) -> TagBoard:
    """The board of the paper's authors: a block of 0.27 units on the middle of a square of 0.81, 108 tags.

    The square lies in the plane z = 0 with a corner at the origin; its eight outer cells are faces 0 to 7, 0.27 wide.
    The walls of the block over the cell in the middle are faces 8 to 11 (towards +x, +y, -x, -y), and the object
    stands on top of it at z = 0.27. The positions are those of calib_camera_with_apriltag.py in
    https://github.com/alexkeroro86/SampleNeRFRO; a module is 0.01 units, and a face has 3x3 tags of tagStandard41h12.
    All lengths go with a tag's side between the corners that are detected; 0.05 is the authors'.
    """
    module = tag / 5
    side, columnwise = 27 * module, np.arange(9).reshape(3, 3).T
    cells = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
    faces = [
        Face((side * x, side * y, 0), (0, 1, 0), (1, 0, 0), columnwise + 9 * number)
        for number, (x, y) in enumerate(cells)
    ]
    walls = [(2, 1, 0, 1), (2, 2, -1, 0), (1, 2, 0, -1), (1, 1, 1, 0)]
    faces += [
        Face((side * x, side * y, side), (right_x, right_y, 0), (0, 0, -1), columnwise + 9 * number)
        for number, (x, y, right_x, right_y) in enumerate(walls, len(cells))
    ]
    return TagBoard("tagStandard41h12", module, tuple(faces))


def tag_grid(family: Family, rows: int, columns: int, tag: float) -> TagBoard:
    """Tags 0, 1, ... row by row on one sheet in the plane z = 0: x to its right, y to its top, z out of the paper.

    The side of a tag between the corners that are detected is in the unit of the poses.
    """
    side, inset = LAYOUTS[family]
    module = tag / (side - 2 * inset)
    ids = np.arange(rows * columns).reshape(rows, columns)
    return TagBoard(family, module, (Face((0, rows * side * module, 0), (1, 0, 0), (0, -1, 0), ids),))


def draw_tag(family: Family, number: int) -> UInt8[np.ndarray, "S S"]:
    """A tag, one pixel for each module."""
    # The struct apriltag_family of https://github.com/AprilRobotics/apriltag, drawn as its apriltag_to_image does.
    codes = tag_detector(family).tag_families[family].contents
    if not 0 <= number < codes.ncodes:
        raise NerfroError(f"{family} has no tag {number}; it has 0 to {codes.ncodes - 1}, so make the board smaller")
    side = codes.total_width
    tag = np.zeros((side, side), np.uint8)
    white = codes.width_at_border + (0 if codes.reversed_border else 2)
    start = (side - white) // 2
    tag[start : start + white, start : start + white] = np.pad(np.zeros((white - 2,) * 2), 1, constant_values=255)
    start = (side - codes.width_at_border) // 2
    for bit in range(codes.nbits):
        column, row = codes.bit_x[bit] + start, codes.bit_y[bit] + start
        tag[row, column] = 255 * (codes.codes[number] >> (codes.nbits - 1 - bit) & 1)
    return tag


@functools.cache
def tag_detector(family: Family) -> Any:
    """The pyapriltags.Detector of a family, which also holds its codes."""
    try:
        from pyapriltags import Detector
    except ImportError as error:
        raise NerfroError(f"AprilTags need pyapriltags ({error}); pip install 'nerfro[capture]'") from error
    # Not pupil-apriltags: its old library writes past its memory where a picture is full of detail.
    # Full resolution: decimated edges cost accuracy, and calibration is in no hurry.
    return Detector(families=family, nthreads=1, quad_decimate=1.0)


def _on_face(face: Face, places: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Points of a face, given as lengths to the right and down from its upper left corner."""
    return np.array(face.origin) + places @ np.array([face.right, face.down], np.float64)
