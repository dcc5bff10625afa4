"""Calibration targets: detection of their points in a photograph, and their sheets for printing in true size."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from nerfro.capture.boards import TagBoard, tag_detector
from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file

_DOTS_PER_METRE = 300 / 0.0254
_MARGIN, _WIDEST = 0.008, 3.0  # metres


@dataclass(frozen=True)
class Sighting:
    """Points of a target that were detected in one image.

    Attributes:
        features: number of the tag or corner of each point.
        points: positions in the frame and unit of the target.
        pixels: image positions (column, row); integers are corners of pixels.
    """

    features: Int[np.ndarray, "N"]
    points: Float[np.ndarray, "N 3"]
    pixels: Float[np.ndarray, "N 2"]

    def only(self, chosen: Bool[np.ndarray, "N"]) -> Sighting:
        """Select points by a mask."""
        return Sighting(self.features[chosen], self.points[chosen], self.pixels[chosen])

    @property
    def num_features(self) -> int:
        return len(np.unique(self.features))


@dataclass(frozen=True)
class Sheet:
    """One printed page of a target.

    Attributes:
        title: caption of the page.
        levels: grey levels, from 0 (black) to 255 (white).
        corners: upper left, upper right, lower right and lower left corner, in the frame and unit of the target.
    """

    title: str
    levels: UInt8[np.ndarray, "H W"]
    corners: Float[np.ndarray, "4 3"]


class Target(ABC):
    """A printed calibration target in the scene.

    Attributes:
        feature: noun in the plural for the detected features, used in messages.
        min_features: images with fewer features are skipped.
    """

    feature: str
    min_features: int

    @abstractmethod
    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        """Detect the points of the target in a grey image."""

    @abstractmethod
    def sheets(self) -> list[Sheet]:
        """Return the pages to print."""


class TagTarget(Target):
    """A board of AprilTags."""

    # The paper's authors require twelve corners, four for each tag.
    feature, min_features = "tags", 3

    def __init__(self, board: TagBoard) -> None:
        self.board, self.corners = board, board.tag_corners()

    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        # The library counts pixels from the corner of the image, as nerfro does, and orders the corners of a tag
        # anticlockwise from the lower left one.
        tags = [tag for tag in tag_detector(self.board.family).detect(image) if tag.tag_id in self.corners]
        repeated = {tag.tag_id for tag in tags if sum(other.tag_id == tag.tag_id for other in tags) > 1}
        tags = [tag for tag in tags if tag.tag_id not in repeated]  # one of two equal tags is a reflection or misread
        return Sighting(
            np.repeat(np.array([tag.tag_id for tag in tags], int), 4),
            np.concatenate([np.empty((0, 3)), *(self.corners[tag.tag_id] for tag in tags)]),
            np.concatenate([np.empty((0, 2)), *(tag.corners[::-1] for tag in tags)]),
        )

    def sheets(self) -> list[Sheet]:
        return [
            Sheet(
                f"face {number} (tags {face.ids.min()} to {face.ids.max()}), its front towards {face.front}",
                self.board.draw(face),
                self.board.face_corners(face),
            )
            for number, face in enumerate(self.board.faces)
        ]


class CharucoTarget(Target):
    """A ChArUco board: a chessboard with ArUco markers on the white squares, in the plane z = 0, y to the top.

    Args:
        columns, rows: number of squares.
        square, marker: side of a square and of a marker, in the unit of the poses.
        dictionary: name of the marker dictionary without OpenCV's prefix "DICT_".
    """

    feature, min_features = "chessboard corners", 6

    def __init__(self, columns: int, rows: int, square: float, marker: float, dictionary: str) -> None:
        cv2 = opencv()
        number = getattr(cv2.aruco, f"DICT_{dictionary}", None)
        if number is None:
            known = sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise NerfroError(f"dictionary={dictionary} does not exist; choose one of {', '.join(known)}")
        if min(columns, rows) < 3 or not 0 < marker < square:
            raise NerfroError(
                f"columns={columns}, rows={rows}, size={square}, marker={marker} do not describe a ChArUco board; "
                "choose at least 3 squares per side, and a marker smaller than a square"
            )
        self.columns, self.rows, self.square = columns, rows, square
        try:
            markers = cv2.aruco.getPredefinedDictionary(number)
            self.board = cv2.aruco.CharucoBoard((columns, rows), square, marker, markers)
            self.detector = cv2.aruco.CharucoDetector(self.board)
        except cv2.error as error:
            raise NerfroError(
                f"dictionary={dictionary} has too few markers for {columns}x{rows} squares; choose a larger dictionary"
            ) from error

    def find(self, image: UInt8[np.ndarray, "H W"]) -> Sighting:
        corners, numbers, _, _ = self.detector.detectBoard(image)
        if numbers is None:
            return Sighting(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2)))
        numbers = np.asarray(numbers).reshape(-1)
        # OpenCV puts pixel centres at integers, and its board has the y axis downwards.
        points = np.asarray(self.board.getChessboardCorners(), np.float64)[numbers]
        points = np.column_stack([points[:, 0], self.rows * self.square - points[:, 1], np.zeros(len(points))])
        return Sighting(numbers, points, np.asarray(corners, np.float64).reshape(-1, 2) + 0.5)

    def sheets(self) -> list[Sheet]:
        pixels = 64  # per square
        levels = self.board.generateImage((self.columns * pixels, self.rows * pixels), marginSize=0)
        right, top = self.columns * self.square, self.rows * self.square
        corners = np.array([[0, top, 0], [right, top, 0], [right, 0, 0], [0, 0, 0]])
        return [Sheet(f"ChArUco board, {self.columns}x{self.rows} squares", np.asarray(levels), corners)]


def print_sheets(sheets: list[Sheet], folder: Path) -> list[Path]:
    """Write board.pdf with one page per sheet, and the same pages as board_<number>.png.

    The unit of the target is interpreted as one metre. A page is a sheet with a margin, to be printed at 100 %.
    """
    pages, resolution = [], 0.0
    for sheet in sheets:
        # An integer number of pixels for each pixel of the sheet keeps edges sharp and in place.
        width = float(np.linalg.norm(sheet.corners[1] - sheet.corners[0]))
        if width > _WIDEST:
            message = f"the board is {width:g} m wide, the limit is {_WIDEST:g} m; give size= in metres"
            raise NerfroError(message)
        enlarged = max(1, round(width * _DOTS_PER_METRE / sheet.levels.shape[1]))
        levels = np.kron(sheet.levels, np.ones((enlarged, enlarged), np.uint8))
        per_metre = levels.shape[1] / width
        resolution = 0.0254 * per_metre
        margin = round(_MARGIN * per_metre)
        page = Image.fromarray(np.pad(levels, margin, constant_values=255))
        caption = f"{sheet.title}; {1000 * width:.1f} mm wide: print at 100 % and measure"
        size = 0.45 * margin
        size *= min(1, levels.shape[1] / ImageFont.load_default(size).getlength(caption))
        place = margin, page.height - margin / 2
        ImageDraw.Draw(page).text(place, caption, 0, ImageFont.load_default(size), anchor="lm")
        pages.append(page.convert("1", dither=Image.Dither.NONE))  # a PDF of grey levels would be lossy
    files = [folder / "board.pdf", *(folder / f"board_{number:02d}.png" for number in range(len(pages)))]
    with atomic_file(files[0]) as stream:
        pages[0].save(stream, "PDF", save_all=True, append_images=pages[1:], resolution=resolution)
    for file, page in zip(files[1:], pages, strict=True):
        with atomic_file(file) as stream:
            page.save(stream, "PNG", dpi=(resolution, resolution))
    return files


@functools.cache
def opencv() -> ModuleType:
    """Import OpenCV, or raise an error with the command that installs OpenCV."""
    try:
        import cv2
    except ImportError as error:
        message = f"OpenCV is needed ({error}); pip install 'nerfro[capture]', or opencv-python-headless"
        raise NerfroError(message) from error
    return cv2
