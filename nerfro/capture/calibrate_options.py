"""What `python -m nerfro.calibrate` can be asked: which board, which lens."""

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
    """What `python -m nerfro.calibrate` is asked.

    Attributes:
        images: folder of the photographs, all of one lens and size; masks (`mask_*`) may lie among them.
        out: folder that is written: transforms_{train,val,test}.json, calibration.json, cameras.png.
        target: `apriltag` or `charuco`, a board that lies in the scene, or `colmap`, the scene itself.
        board: of AprilTags: `twelve_faces` (the paper's) or `grid`, one sheet.
        family: of the tags, `tag36h11` (default of grids) or `tagStandard41h12` (of the twelve faces).
        columns, rows: tags of a grid, or squares of a ChArUco board; by default 5 and 7.
        size: side of a tag between its detected corners (where a grid's outer borders end), or of a ChArUco square, in
            the unit that poses shall have; metres for printing. By default 0.05, or 0.04 for a square.
        marker: side of a ChArUco marker in the same unit; by default half a square.
        dictionary: of the ChArUco markers.
        write_board: write the board to print, board.pdf and board_*.png, into `out`, and nothing else without images.
        reconstruction: folder of a COLMAP model; by default `images`/../sparse/0 or /sparse; made where there is none.
        pairs: of images that COLMAP matches: `sequential`, each with the ten next by name and ever fewer beyond, or
            `all`; by default sequential where the names count.
        threads: that COLMAP may take; by default one for each core.
        lens: what is estimated beside focal lengths and principal point: `pinhole` nothing, as in the paper; `radial`
            k1 and k2; `opencv` k1, k2, p1 and p2.
        intrinsics: fx, fy, cx, cy in pixels from the image's corner, for a lens that is known; nothing is estimated.
        distortion: of that lens, OpenCV's k1, k2, p1, p2.
        test_every: every such image by name is for test, and as many for validation.
        overwrite: whether files that exist may be replaced.
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
    """The lens that is given, if one is; options that can be refused are refused here."""
    if config.out is None:
        raise NerfroError("set out= to the folder that takes the data set")
    if config.images is None and not (config.write_board and config.target != "colmap"):
        raise NerfroError("set images= to the folder of the photographs; or write_board=true for a board to print")
    if config.intrinsics is None:
        if config.distortion:
            raise NerfroError("distortion= belongs to a lens that is known; give intrinsics=[fx,fy,cx,cy] as well")
        return None
    if len(config.intrinsics) != 4 or len(config.distortion or ()) not in (0, 4):
        raise NerfroError(
            f"intrinsics={config.intrinsics}, distortion={config.distortion} are no lens; give fx, fy, cx, cy in "
            "pixels, and k1, k2, p1, p2 or nothing"
        )
    fx, fy, cx, cy = config.intrinsics
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), tuple(config.distortion or ()))


def make_target(config: DictConfig) -> Target:
    """The board that the options describe."""
    columns, rows = config.columns or 5, config.rows or 7
    if config.target == "charuco":
        square = config.size or 0.04
        return CharucoTarget(columns, rows, square, config.marker or 0.5 * square, config.dictionary)
    if config.board == "grid":
        return TagTarget(tag_grid(config.family or "tag36h11", rows, columns, config.size or 0.05))
    if config.columns or config.rows or config.family not in (None, "tagStandard41h12"):
        raise NerfroError(
            "board=twelve_faces has 3x3 tags of tagStandard41h12 on each face; set board=grid for other tags"
        )
    return TagTarget(twelve_faces(config.size or 0.05))
