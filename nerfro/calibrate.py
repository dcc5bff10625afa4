"""`python -m nerfro.calibrate images=DIR target=apriltag out=DIR`: estimate lens and poses of photographs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

import numpy as np
from omegaconf import DictConfig

from nerfro.allowed import Count, Natural, Positive, Range
from nerfro.capture.boards import TagBoard, print_sheets, tag_grid, twelve_faces
from nerfro.capture.calibrated_data import FILES, ray_range, relative, split_views, write_calibrated
from nerfro.capture.calibration import Calibration, calibrate
from nerfro.capture.photographs import list_photographs, luminance, outside
from nerfro.capture.reconstruction import SfmSettings, find_model, import_model
from nerfro.cli import entry_point, warn
from nerfro.data.frames import Every
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing
from nerfro.paths import user_path
from nerfro.progress import track

Squares = Annotated[int, Range(at_least=1, at_most=100)]  # along a side of a board


@dataclass
class CalibrateConfig:
    """Options of `python -m nerfro.calibrate`.

    Attributes:
        images: folder of the photographs, all with one lens and size; the folder may also contain masks (`mask_*`).
        out: output folder for transforms_{train,val,test}.json, calibration.json and cameras.png.
        target: `apriltag` for a board of AprilTags in the scene, or `colmap` for structure from motion.
        board: layout of the tags: `twelve_faces` (the paper's board, of tagStandard41h12) or `grid`, one sheet of
            tag36h11.
        columns, rows: number of tags of a grid; by default 5 and 7.
        size: side of a tag between its detected corners (in a grid: up to the outer borders), in the unit of the poses;
            metres for printing.
        write_board: write the board for printing, board.pdf and board_*.png, to `out`. Without `images` the command
            ends there.
        reconstruction: folder of a COLMAP model; by default `images`/../sparse/0 or /sparse, else a new model.
        pairs: image pairs that COLMAP matches: `sequential` (each image with the ten next ones, and with fewer distant
            ones) or `all`; by default sequential if the file names are numbered.
        threads: number of threads of COLMAP; by default one per core.
        lens: distortion coefficients to estimate beside focal lengths and principal point: `pinhole` none, as in the
            paper; `radial` k1 and k2; `opencv` k1, k2, p1 and p2.
        mask_labels: labels of the object in the masks, as `data.mask_labels`; by default all but the background.
        test_every: every such image by name is a test image, and as many are validation images.
        overwrite: allow replacing existing files.
    """

    images: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    out: Optional[str] = None  # noqa: UP045
    target: Annotated[str, Literal["apriltag", "colmap"]] = "apriltag"
    board: Annotated[str, Literal["twelve_faces", "grid"]] = "twelve_faces"
    columns: Optional[Squares] = None  # noqa: UP045
    rows: Optional[Squares] = None  # noqa: UP045
    size: Positive = 0.05
    write_board: bool = False
    reconstruction: Optional[str] = None  # noqa: UP045
    pairs: Annotated[Optional[str], Literal["sequential", "all"]] = None  # noqa: UP045
    threads: Optional[Count] = None  # noqa: UP045
    lens: Annotated[str, Literal["pinhole", "radial", "opencv"]] = "pinhole"
    mask_labels: Optional[list[Natural]] = None  # noqa: UP045
    test_every: Every = 8
    overwrite: bool = False


def check_options(config: DictConfig) -> None:
    """Check the options.

    Raises:
        NerfroError: an option is missing.
    """
    if config.out is None:
        raise NerfroError("out= is missing; set out= to the folder for the data set")
    if config.images is None and not (config.write_board and config.target != "colmap"):
        raise NerfroError(
            "images= is missing; set images= to the folder of the photographs, or write_board=true to print a board"
        )


def make_board(config: DictConfig) -> TagBoard:
    """Build the board that the options describe."""
    if config.board == "grid":
        return tag_grid(config.rows or 7, config.columns or 5, config.size)
    if config.columns or config.rows:
        raise NerfroError("board=twelve_faces always has 3x3 tags on each face; set board=grid for columns= and rows=")
    return twelve_faces(config.size)


# Limits above which a warning is printed: reprojection error in pixels, and relative deviation of the focal length.
_MAX_ERROR, _MAX_FOCAL_DEVIATION = 0.7, 0.02


@entry_point("calibrate", CalibrateConfig)
def main(config: DictConfig) -> None:
    """Detect the board, estimate lens and poses, write the data set, and print the next command."""
    check_options(config)
    out = user_path(config.out)
    board = None if config.target == "colmap" else make_board(config)
    if config.write_board:
        _write_board(board, out, config.overwrite)
        if config.images is None:
            return
    images, size = list_photographs(user_path(config.images))
    # Masks lie where the loader of the data set will look for them.
    masks = [find_mask(out, out / relative(image, out)) for image in images]
    refuse_existing([out / name for name in FILES], config.overwrite)
    if board is None:
        settings = SfmSettings(config.lens, config.pairs, config.threads, config.mask_labels)
        model = find_model(config.reconstruction, images, masks, out / "sparse", settings, config.overwrite)
        calibration, points = import_model(model, images, size)
        quads, seen = [], points
    else:
        sightings = {
            image.name: outside(board.find(luminance(image)), mask, config.mask_labels)
            for image, mask in zip(track("detecting tags", images), masks, strict=True)
        }
        calibration = calibrate(sightings, size, config.lens)
        quads, points = [sheet.corners for sheet in board.sheets()], np.empty((0, 3))
        seen = np.concatenate(quads)
    _report(calibration, "points" if board is None else "tags", config.lens == "pinhole")
    splits = split_views([image.name for image in images if image.name in calibration.poses], config.test_every)
    reach = ray_range(calibration, seen)
    written = write_calibrated(out, images, size, calibration, splits, config.target, quads, points, reach)
    print(f"wrote {', '.join(written)}")
    options = ["data=opencv", f"data.root={out}", *reach]
    if any(masks):
        command = ["nerfro.preprocess", *options, "medium.ior=1.33"]
    else:
        command = ["nerfro.mask", *options, "outlines={NAME:[LEFT,TOP,RIGHT,BOTTOM]}"]
    print(f"next: {shlex.join(['python', '-m', *command])}")


def _write_board(board: TagBoard | None, out: Path, overwrite: bool) -> None:
    if board is None:
        raise NerfroError("target=colmap has no board to write; choose target=apriltag")
    refuse_existing([out / "board.pdf"], overwrite)
    files = print_sheets(board.sheets(), out)
    print(f"wrote {files[0]} ({len(files) - 1} pages, in true size if the unit is a metre) and the pages as PNG")


def _report(calibration: Calibration, feature: str, may_distort: bool) -> None:
    print("\n".join(calibration.lines(feature)))
    lens = calibration.intrinsics
    if calibration.mean_error > _MAX_ERROR and may_distort and not lens.distortion:
        warn("the reprojection error is large; for a lens with distortion set lens=radial or lens=opencv")
    if lens.focal_deviation is not None and lens.focal_deviation > _MAX_FOCAL_DEVIATION * lens.matrix[0, 0]:
        warn("the focal length is uncertain; photograph the board also at a slant, and from near and far")


if __name__ == "__main__":
    main()
