"""Options of `python -m nerfro.calibrate`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Optional

import numpy as np
from omegaconf import DictConfig

from nerfro.allowed import Count, Positive, Range
from nerfro.capture.boards import tag_grid, twelve_faces
from nerfro.capture.calibration import Intrinsics
from nerfro.capture.targets import CharucoTarget, TagTarget, Target
from nerfro.data.frames import Every
from nerfro.errors import NerfroError

Squares = Annotated[int, Range(at_least=1, at_most=100)]  # along a side of a board


@dataclass
class CalibrateConfig:
    """Options of `python -m nerfro.calibrate`.

    Attributes:
        images: folder of the photographs, all with one lens and size; the folder may also contain masks (`mask_*`).
        out: output folder for transforms_{train,val,test}.json, calibration.json and cameras.png.
        target: `apriltag` or `charuco` for a board in the scene, or `colmap` for structure from motion.
        board: layout of AprilTags: `twelve_faces` (the paper's board) or `grid`, one sheet.
        family: tag family, `tag36h11` (default of `grid`) or `tagStandard41h12` (used by `twelve_faces`).
        columns, rows: number of tags of a grid, or of squares of a ChArUco board; by default 5 and 7.
        size: side of a tag between its detected corners (in a grid: up to the outer borders), or of a ChArUco square,
            in the unit of the poses; metres for printing. By default 0.05, or 0.04 for a square.
        marker: side of a ChArUco marker in the same unit; by default half a square.
        dictionary: dictionary of the ChArUco markers.
        write_board: write the board for printing, board.pdf and board_*.png, to `out`. Without `images` the command
            ends there.
        reconstruction: folder of a COLMAP model; by default `images`/../sparse/0 or /sparse, else a new model.
        pairs: image pairs that COLMAP matches: `sequential` (each image with the ten next ones, and with fewer distant
            ones) or `all`; by default sequential if the file names are numbered.
        threads: number of threads of COLMAP; by default one per core.
        lens: distortion coefficients to estimate beside focal lengths and principal point: `pinhole` none, as in the
            paper; `radial` k1 and k2; `opencv` k1, k2, p1 and p2.
        intrinsics: fx, fy, cx, cy of a known lens, in pixels from the corner of the image; the lens stays fixed.
        distortion: OpenCV's k1, k2, p1, p2 of the known lens.
        test_every: every such image by name is a test image, and as many are validation images.
        overwrite: allow replacing existing files.
    """

    images: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    out: Optional[str] = None  # noqa: UP045
    target: Annotated[str, Literal["apriltag", "charuco", "colmap"]] = "apriltag"
    board: Annotated[str, Literal["twelve_faces", "grid"]] = "twelve_faces"
    family: Annotated[Optional[str], Literal["tag36h11", "tagStandard41h12"]] = None  # noqa: UP045
    columns: Optional[Squares] = None  # noqa: UP045
    rows: Optional[Squares] = None  # noqa: UP045
    size: Optional[Positive] = None  # noqa: UP045
    marker: Optional[Positive] = None  # noqa: UP045
    dictionary: str = "6X6_250"
    write_board: bool = False
    reconstruction: Optional[str] = None  # noqa: UP045
    pairs: Annotated[Optional[str], Literal["sequential", "all"]] = None  # noqa: UP045
    threads: Optional[Count] = None  # noqa: UP045
    lens: Annotated[str, Literal["pinhole", "radial", "opencv"]] = "pinhole"
    intrinsics: Optional[list[Positive]] = None  # noqa: UP045
    distortion: Optional[list[float]] = None  # noqa: UP045
    test_every: Every = 8
    overwrite: bool = False


def check_options(config: DictConfig) -> Intrinsics | None:
    """Check the options and return the known lens, or None.

    Raises:
        NerfroError: options are missing or contradict each other.
    """
    if config.out is None:
        raise NerfroError("out= is missing; set out= to the folder for the data set")
    if config.images is None and not (config.write_board and config.target != "colmap"):
        raise NerfroError(
            "images= is missing; set images= to the folder of the photographs, or write_board=true to print a board"
        )
    if config.intrinsics is None:
        if config.distortion:
            raise NerfroError("distortion= needs a known lens; give intrinsics=[fx,fy,cx,cy] as well")
        return None
    if len(config.intrinsics) != 4 or len(config.distortion or ()) not in (0, 4):
        raise NerfroError(
            f"intrinsics={config.intrinsics}, distortion={config.distortion} do not describe a lens; give "
            "intrinsics=[fx,fy,cx,cy] in pixels, and distortion=[k1,k2,p1,p2] or none"
        )
    fx, fy, cx, cy = config.intrinsics
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), tuple(config.distortion or ()))


def make_target(config: DictConfig) -> Target:
    """Build the target that the options describe."""
    columns, rows = config.columns or 5, config.rows or 7
    if config.target == "charuco":
        square = config.size or 0.04
        return CharucoTarget(columns, rows, square, config.marker or 0.5 * square, config.dictionary)
    if config.board == "grid":
        return TagTarget(tag_grid(config.family or "tag36h11", rows, columns, config.size or 0.05))
    if config.columns or config.rows or config.family not in (None, "tagStandard41h12"):
        raise NerfroError(
            "board=twelve_faces always has 3x3 tags of tagStandard41h12 on each face; set board=grid for other tags"
        )
    return TagTarget(twelve_faces(config.size or 0.05))
