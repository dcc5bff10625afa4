"""The command `calibrate`: from the options to the data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from nerfro.cli.overrides import as_overrides, print_next
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import relative_path, user_path
from nerfro.core.progress import track
from nerfro.data.masks import find_mask, require_used
from nerfro.files.atomic import refuse_existing
from nerfro.files.folder_lock import lock_folder
from nerfro.poses.boards import TagBoard, print_sheets, tag_grid, twelve_faces
from nerfro.poses.calibrated_data import FILES, ray_range, split_views, write_calibrated
from nerfro.poses.calibration import Calibration, calibrate
from nerfro.poses.photographs import list_photographs, luminance, outside_mask
from nerfro.poses.structure_from_motion import SfmSettings, find_model, import_model

# Limits above which a warning is printed: reprojection error in pixels, and relative deviation of the focal length.
_MAX_ERROR, _MAX_FOCAL_DEVIATION = 0.7, 0.02


def run(config: DictConfig) -> None:
    """Estimate lens and poses of photographs, write the data set, and print the next command.

    Args:
        config: resolved `nerfro.calibrate.CalibrateConfig`.

    Raises:
        NerfroError: an option is missing, the photographs do not determine the poses, or files exist.
    """
    _check_options(config)
    out = user_path(config.out)
    with lock_folder(out, "out"):
        _calibrate(config, out)


def _check_options(config: DictConfig) -> None:
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


def _make_board(config: DictConfig) -> TagBoard:
    """Build the board that the options describe."""
    if config.board == "grid":
        return tag_grid(config.rows or 7, config.columns or 5, config.size)
    if config.columns or config.rows:
        raise NerfroError("board=twelve_faces always has 3x3 tags on each face; set board=grid for columns= and rows=")
    return twelve_faces(config.size)


def _calibrate(config: DictConfig, out: Path) -> None:
    board = None if config.target == "colmap" else _make_board(config)
    if config.write_board:
        _write_board(board, out, config.overwrite)
        if config.images is None:
            return
    images, size = list_photographs(user_path(config.images))
    # Masks lie where the loader of the data set will look for them.
    masks = [find_mask(out, out / relative_path(image, out)) for image in images]
    require_used(out, [out / relative_path(image, out) for image in images], masks)
    refuse_existing([out / name for name in FILES], config.overwrite)
    if board is None:
        settings = SfmSettings(config.lens, config.pairs, config.threads, config.mask_labels)
        model = find_model(config.reconstruction, images, masks, out / "sparse", settings, config.overwrite)
        calibration, points = import_model(model, images, size)
        quads, seen = [], points
    else:
        detections = {
            image.name: outside_mask(board.detect(luminance(image)), mask, config.mask_labels)
            for image, mask in zip(track("detecting tags", images), masks, strict=True)
        }
        calibration = calibrate(detections, size, config.lens)
        quads, points = [sheet.corners for sheet in board.sheets()], np.empty((0, 3))
        seen = np.concatenate(quads)
    # With an existing model, the option has no effect.
    may_distort = config.lens == "pinhole" and (board is not None or model.is_relative_to(out / "sparse"))
    _report(calibration, "points" if board is None else "tags", may_distort, out)
    splits = split_views([image.name for image in images if image.name in calibration.poses], config.test_every)
    reach = ray_range(calibration, seen)
    written = write_calibrated(out, images, size, calibration, splits, config.target, (quads, points), reach)
    print(f"wrote {', '.join(written)}")
    options = as_overrides({"data": "opencv", "data.root": out})
    if any(masks):
        print_next("next", "preprocess", options)
    else:
        print_next("next", "mask", [*options, "view=true"])


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
