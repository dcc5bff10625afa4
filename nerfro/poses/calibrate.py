"""Lens and poses of photographs: from the options of `nerfro.calibrate` to the data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerfro.cli.calls import options_of
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import relative_path, user_path
from nerfro.core.progress import track
from nerfro.data.capture import Capture
from nerfro.data.masks import find_mask, require_used
from nerfro.files.atomic import lock_folder, refuse_existing
from nerfro.poses.boards import TagBoard, print_sheets, tag_grid, twelve_faces
from nerfro.poses.calibrated_data import FILES, ray_range, split_views, write_calibrated
from nerfro.poses.calibration import Calibration, calibrate_by_tags
from nerfro.poses.collection import list_photographs, luminance, outside_mask
from nerfro.poses.options import CalibrateConfig
from nerfro.poses.structure_from_motion import SfmSettings, find_model, import_model

# Limits above which a warning is printed: reprojection error in pixels, and relative deviation of the focal length.
_MAX_ERROR, _MAX_FOCAL_DEVIATION = 0.7, 0.02


def calibrate(options: CalibrateConfig | None = None, /, **settings: object) -> Capture:
    """Estimate lens and poses of photographs, and write the data set.

    Args:
        options: the options of `python -m nerfro.calibrate`.
        **settings: options by name, as in `calibrate(images="photographs", target="colmap", out="data/glass")`.

    Returns:
        The data set; without `images`, its folder holds only the board for printing.

    Raises:
        NerfroError: an option is missing, the photographs do not determine the poses, or files exist.
    """
    options = options_of(CalibrateConfig, options, settings)
    if options.out is None:
        raise NerfroError("out= is missing; set out= to the folder for the data set")
    if options.images is None and not (options.write_board and options.target != "colmap"):
        raise NerfroError(
            "images= is missing; set images= to the folder of the photographs, or write_board=true to print a board"
        )
    out = user_path(options.out)
    with lock_folder(out, "out"):
        _calibrate(options, out)
    return Capture(out)


def _make_board(options: CalibrateConfig) -> TagBoard:
    """Build the board that the options describe."""
    if options.board == "grid":
        return tag_grid(options.rows or 7, options.columns or 5, options.size)
    if options.columns or options.rows:
        raise NerfroError("board=twelve_faces always has 3x3 tags on each face; set board=grid for columns= and rows=")
    return twelve_faces(options.size)


def _calibrate(options: CalibrateConfig, out: Path) -> None:
    board = None if options.target == "colmap" else _make_board(options)
    if options.write_board:
        _write_board(board, out, options.overwrite)
    if options.images is None:
        return
    images, size = list_photographs(user_path(options.images))
    # Masks lie where the loader of the data set will look for them.
    masks = [find_mask(out, out / relative_path(image, out)) for image in images]
    require_used(out, [out / relative_path(image, out) for image in images], masks)
    refuse_existing([out / name for name in FILES], options.overwrite)
    if board is None:
        settings = SfmSettings(options.lens, options.pairs, options.threads, options.mask_labels)
        model = find_model(options.reconstruction, images, masks, out / "sparse", settings, options.overwrite)
        calibration, points = import_model(model, images, size)
        quads, seen = [], points
    else:
        detections = {
            image.name: outside_mask(board.detect(luminance(image)), mask, options.mask_labels)
            for image, mask in zip(track("detecting tags", images), masks, strict=True)
        }
        calibration = calibrate_by_tags(detections, size, options.lens)
        quads, points = [board.face_corners(face) for face in board.faces], np.empty((0, 3))
        seen = np.concatenate(quads)
    # With an existing model, the option has no effect.
    may_distort = options.lens == "pinhole" and (board is not None or model.is_relative_to(out / "sparse"))
    _report(calibration, "points" if board is None else "tags", may_distort, out)
    splits = split_views([image.name for image in images if image.name in calibration.poses], options.test_every)
    reach = ray_range(calibration, seen)
    written = write_calibrated(out, images, size, calibration, splits, options.target, (quads, points), reach)
    print(f"wrote {', '.join(written)}")


def _write_board(board: TagBoard | None, out: Path, overwrite: bool) -> None:
    if board is None:
        raise NerfroError("target=colmap has no board to write; choose target=apriltag")
    refuse_existing([out / "board.pdf"], overwrite)
    files = print_sheets(board.sheets(), out)
    print(f"wrote {files[0]} ({len(files) - 1} pages, in true size if the unit is a metre) and the pages as PNG")


def _report(calibration: Calibration, observations: str, may_distort: bool, out: Path) -> None:
    print("\n".join(calibration.lines(observations)))
    lens = calibration.intrinsics
    if calibration.mean_error > _MAX_ERROR and may_distort and not lens.distortion:
        warn(
            "the reprojection error is large; for a lens with distortion set lens=radial or lens=opencv, and delete "
            f"{out / 'sparse'} if it exists"
        )
    if lens.focal_deviation is not None and lens.focal_deviation > _MAX_FOCAL_DEVIATION * lens.matrix[0, 0]:
        warn("the focal length is uncertain; photograph the board also at a slant, and from near and far")
