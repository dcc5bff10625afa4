"""Geometry, print image, printing and detection of AprilTag boards.

A board has a right-handed coordinate frame and a unit of length. A face is a flat sheet of adjacent tags.
"""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from nerfro.core.errors import NerfroError, optional
from nerfro.files.atomic import atomic_file

Family = Literal["tag36h11", "tagStandard41h12"]

_WIDEST = 3.0  # printed page, in metres


class Layout(NamedTuple):
    """Dimensions of the tags of a family, in modules (the black and white squares of a tag)."""

    side: int  # side of a whole tag, including the white border of tag36h11
    inset: int  # distance of the detected corners from the sides of the whole tag


LAYOUTS: dict[Family, Layout] = {"tag36h11": Layout(10, 1), "tagStandard41h12": Layout(9, 2)}


@dataclass(frozen=True)
class TagDetections:
    """Corners of the tags of a board that were detected in one image.

    Attributes:
        tag_ids: number of the tag of each corner.
        board_points: positions in the frame and unit of the board.
        image_points: image positions (column, row); integers are corners of pixels.
    """

    tag_ids: Int[np.ndarray, " corners"]
    board_points: Float[np.ndarray, "corners 3"]
    image_points: Float[np.ndarray, "corners 2"]

    def select(self, chosen: Bool[np.ndarray, " corners"]) -> TagDetections:
        """Select corners by a mask."""
        return TagDetections(self.tag_ids[chosen], self.board_points[chosen], self.image_points[chosen])

    def of_same_tags(self, chosen: Bool[np.ndarray, " corners"]) -> Bool[np.ndarray, " corners"]:
        """Extend a mask to all corners of the tags that it touches."""
        return np.isin(self.tag_ids, self.tag_ids[chosen])

    @property
    def num_tags(self) -> int:
        """Number of different tags."""
        return len(np.unique(self.tag_ids))


@dataclass(frozen=True)
class Sheet:
    """One printed page of a board.

    Attributes:
        title: caption of the page.
        levels: grey levels, from 0 (black) to 255 (white).
        corners: upper left, upper right, lower right and lower left corner, in the frame and unit of the board.
    """

    title: str
    levels: UInt8[np.ndarray, "H W"]
    corners: Float[np.ndarray, "4 3"]


@dataclass(frozen=True)
class Face:
    """A sheet of tags in space.

    Attributes:
        origin: upper left corner of the printed sheet, in board units.
        right, down: unit vectors along the upper and the left edge. The printed side faces along `down` x `right`.
        ids: tag numbers as printed, the top row first.
    """

    origin: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    ids: Int[np.ndarray, "rows columns"]

    @property
    def front(self) -> str:
        """Coordinate axis nearest to the normal of the printed side, for example "+x"."""
        normal = np.cross(self.down, self.right)
        axis = int(np.abs(normal).argmax())
        return f"{'+' if normal[axis] > 0 else '-'}{'xyz'[axis]}"


@dataclass(frozen=True)
class TagBoard:
    """AprilTags on one or several faces."""

    family: Family
    module: float  # side of a module, in board units
    faces: tuple[Face, ...]

    def tag_corners(self) -> dict[int, Float[np.ndarray, "4 3"]]:
        """Return the detected corners of each tag by tag number: upper left, upper right, lower right, lower left."""
        side, inset = LAYOUTS[self.family]
        near, far = inset * self.module, (side - inset) * self.module
        first = np.array([[near, near], [far, near], [far, far], [near, far]])
        return {
            int(number): _on_face(face, first + side * self.module * np.array([column, row]))
            for face in self.faces
            for (row, column), number in np.ndenumerate(face.ids)
        }

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> TagDetections:
        """Detect the corners of the tags in a grey image."""
        # The library counts pixels from the corner of the image, as nerfro does, and orders the corners of a tag
        # anticlockwise from the lower left one.
        corners = self.tag_corners()
        tags = [tag for tag in tag_detector(self.family).detect(image) if tag.tag_id in corners]
        counts = Counter(tag.tag_id for tag in tags)
        tags = [tag for tag in tags if counts[tag.tag_id] == 1]  # one of two equal tags is a reflection or misread
        return TagDetections(
            np.repeat(np.array([tag.tag_id for tag in tags], int), 4),
            np.concatenate([np.empty((0, 3)), *(corners[tag.tag_id] for tag in tags)]),
            np.concatenate([np.empty((0, 2)), *(tag.corners[::-1] for tag in tags)]),
        )

    def sheets(self) -> list[Sheet]:
        """Return the pages to print."""
        return [
            Sheet(
                f"face {number} (tags {face.ids.min()} to {face.ids.max()}), its front towards {face.front}",
                self.draw(face),
                self.face_corners(face),
            )
            for number, face in enumerate(self.faces)
        ]

    def face_corners(self, face: Face) -> Float[np.ndarray, "4 3"]:
        """Return the corners of a whole sheet: upper left, upper right, lower right, lower left."""
        rows, columns = face.ids.shape
        height, width = (LAYOUTS[self.family].side * self.module * count for count in (rows, columns))
        return _on_face(face, np.array([[0, 0], [width, 0], [width, height], [0, height]]))

    def draw(self, face: Face, module_pixels: int = 1) -> UInt8[np.ndarray, "H W"]:
        """Draw a sheet as printed, without a margin: 0 is black, 255 is white."""
        sheet = np.block([[draw_tag(self.family, int(number)) for number in row] for row in face.ids])
        return np.kron(sheet, np.ones((module_pixels, module_pixels), np.uint8))


def twelve_faces(tag: float = 0.05) -> TagBoard:
    """Return the board of the paper's authors: a cubic block of side 0.27 in the middle of a square of side 0.81.

    The square lies in the plane z = 0 with a corner at the origin. Its eight outer cells, 0.27 wide, are faces 0 to 7.
    The walls of the block on the middle cell are faces 8 to 11 (towards +x, +y, -x, -y), and the object
    stands on top of the block at z = 0.27. The positions are taken from calib_camera_with_apriltag.py in
    https://github.com/alexkeroro86/SampleNeRFRO. A module measures 0.01 units, and a face has 3x3 tags of
    tagStandard41h12, 108 tags in all.

    Args:
        tag: side of a tag between its detected corners, which scales the whole board; the authors use 0.05.
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


def tag_grid(rows: int, columns: int, tag: float) -> TagBoard:
    """Return a board of tags 0, 1, ... of tag36h11, row by row on one sheet in the plane z = 0.

    The x axis points to the right of the sheet, the y axis to the top, and the z axis out of the paper.

    Args:
        rows, columns: number of tags.
        tag: side of a tag between its detected corners, in the unit of the poses.
    """
    side, inset = LAYOUTS["tag36h11"]
    module = tag / (side - 2 * inset)
    ids = np.arange(rows * columns).reshape(rows, columns)
    return TagBoard("tag36h11", module, (Face((0, rows * side * module, 0), (1, 0, 0), (0, -1, 0), ids),))


def draw_tag(family: Family, number: int) -> UInt8[np.ndarray, "side side"]:
    """Draw a tag with one pixel per module."""
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
    """Return the pyapriltags.Detector of a family, which also holds the codes of the family."""
    pyapriltags = optional("pyapriltags", "capture", "AprilTags need pyapriltags")
    # pupil-apriltags is no alternative: its older library writes past its memory on images with much detail.
    # Decimation would be faster, but less accurate.
    return pyapriltags.Detector(families=family, nthreads=1, quad_decimate=1.0)


def _on_face(face: Face, places: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    """Convert coordinates on a face (lengths to the right and down from the upper left corner) to board coordinates."""
    return np.array(face.origin) + places @ np.array([face.right, face.down], np.float64)


def print_sheets(sheets: list[Sheet], folder: Path) -> list[Path]:
    """Write board.pdf with one page per sheet, and the same pages as board_<number>.png.

    The unit of the board is interpreted as one metre. A page is a sheet with a margin, to be printed at 100 %.
    """
    pages, resolution = [], 0.0
    for sheet in sheets:
        # An integer number of pixels for each pixel of the sheet keeps edges sharp and in place.
        width = float(np.linalg.norm(sheet.corners[1] - sheet.corners[0]))
        if width > _WIDEST:
            message = f"the board is {width:g} m wide, the limit is {_WIDEST:g} m; give size= in metres"
            raise NerfroError(message)
        enlarged = max(1, round(width * (300 / 0.0254) / sheet.levels.shape[1]))
        levels = np.kron(sheet.levels, np.ones((enlarged, enlarged), np.uint8))
        per_metre = levels.shape[1] / width
        resolution = 0.0254 * per_metre
        margin = round(0.008 * per_metre)
        page = Image.fromarray(np.pad(levels, margin, constant_values=255))
        caption = f"{sheet.title}; {1000 * width:.1f} mm wide: print at 100 % and measure"
        size = 0.45 * margin
        size *= min(1, levels.shape[1] / ImageFont.load_default(size).getlength(caption))
        position = margin, page.height - margin / 2
        ImageDraw.Draw(page).text(position, caption, 0, ImageFont.load_default(size), anchor="lm")
        pages.append(page.convert("1", dither=Image.Dither.NONE))  # a PDF of grey levels would be lossy
    files = [folder / "board.pdf", *(folder / f"board_{number:02d}.png" for number in range(len(pages)))]
    with atomic_file(files[0]) as stream:
        pages[0].save(stream, "PDF", save_all=True, append_images=pages[1:], resolution=resolution)
    for file, page in zip(files[1:], pages, strict=True):
        with atomic_file(file) as stream:
            page.save(stream, "PNG", dpi=(resolution, resolution))
    return files
