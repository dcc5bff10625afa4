"""`python -m nerfro.calibrate images=DIR target=apriltag out=DIR`: lens and poses of photographs."""

from __future__ import annotations

import json
import os
import shlex
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float, UInt8
from omegaconf import DictConfig
from rich.progress import track

from nerfro.capture.boards import LAYOUTS, tag_grid, twelve_faces
from nerfro.capture.calibration import Calibration, Intrinsics, calibrate
from nerfro.capture.camera_plot import draw_cameras
from nerfro.capture.printing import print_sheets
from nerfro.capture.reconstruction import import_model, reconstruct
from nerfro.capture.targets import CharucoTarget, Sighting, TagTarget, Target
from nerfro.cli import entry_point
from nerfro.data.frames import list_images
from nerfro.data.image_files import read_mask, read_rgb
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.light import to_linear

_TARGETS, _BOARDS, _LENSES = (
    ("apriltag", "charuco", "colmap"),
    ("twelve_faces", "grid"),
    ("pinhole", "radial", "opencv"),
)
_SPLITS = ("train", "val", "test")
_REPORT, _PLOT = "calibration.json", "cameras.png"
_MODEL_FOLDERS = ("sparse/0", "sparse")
# Errors above this are told to be large, pixels; a focal length less certain than this is told to be uncertain.
_GOOD_ERROR, _GOOD_FOCAL = 0.7, 0.02
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB (ITU-R BT.709)


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
        model: folder of a COLMAP model; by default `images`/../sparse/0 or /sparse, and made anew where there is none.
        lens: what is estimated beside focal lengths and principal point: `pinhole` nothing, as in the paper; `radial`
            k1 and k2; `opencv` k1, k2, p1 and p2.
        intrinsics: fx, fy, cx, cy in pixels from the image's corner, for a lens that is known; nothing is estimated.
        distortion: of that lens, OpenCV's k1, k2, p1, p2.
        test_every: every such image by name is for test, and as many for validation.
        overwrite: whether files that exist may be replaced.
    """

    images: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    out: Optional[str] = None  # noqa: UP045
    target: str = "apriltag"
    board: str = "twelve_faces"
    family: Optional[str] = None  # noqa: UP045
    columns: Optional[int] = None  # noqa: UP045
    rows: Optional[int] = None  # noqa: UP045
    size: Optional[float] = None  # noqa: UP045
    marker: Optional[float] = None  # noqa: UP045
    dictionary: str = "6X6_250"
    write_board: bool = False
    model: Optional[str] = None  # noqa: UP045
    lens: str = "pinhole"
    intrinsics: Optional[list[float]] = None  # noqa: UP045
    distortion: Optional[list[float]] = None  # noqa: UP045
    test_every: int = 8
    overwrite: bool = False


@entry_point("calibrate", CalibrateConfig)
def main(config: DictConfig) -> None:
    """Find the target, estimate, write the data set, and say what to do next."""
    given = _check(config)
    out = Path(config.out).expanduser()
    target = None if config.target == "colmap" else make_target(config)
    if config.write_board:
        _write_board(config, target, out)
        if config.images is None:
            return
    images, size = _list_photographs(Path(config.images).expanduser())
    # Where the loader of the data set will look for them.
    masks = [find_mask(out, out / _relative(image, out)) for image in images]
    names = [*(f"transforms_{split}.json" for split in _SPLITS), _REPORT, _PLOT]
    refuse_existing([out / name for name in names], config.overwrite)
    quads: list[Float[np.ndarray, "4 3"]] = []
    if target is None:
        calibration, points = import_model(_find_model(config, images, masks, out, given), images, size)
    else:
        sightings = {
            image.name: _outside(target.find(luminance(image)), mask)
            for image, mask in zip(track(images, f"looking for {target.feature}"), masks, strict=True)
        }
        calibration = calibrate(sightings, size, config.lens, given, target.fewest, target.feature)
        quads = [sheet.corners for sheet in target.sheets()]
        points = np.empty((0, 3))
    splits = split_views([image.name for image in images if image.name in calibration.poses], config.test_every)
    _report(calibration, config, "points" if target is None else target.feature)
    _write(out, images, size, calibration, splits, config.target, quads, points)
    seen = points if target is None else np.concatenate(quads)
    print("next: " + shlex.join(_next_command(out, calibration, seen, any(masks))))


def _check(config: DictConfig) -> Intrinsics | None:
    """The lens that is given, if one is; options that can be refused are refused here.

    Raises:
        NerfroError: an option is missing or out of range.
    """
    for name, allowed in (("target", _TARGETS), ("board", _BOARDS), ("lens", _LENSES), ("family", (*LAYOUTS, None))):
        if config[name] not in allowed:
            raise NerfroError(
                f"{name}={config[name]} is not allowed; choose one of {', '.join(str(one) for one in allowed if one)}"
            )
    if config.out is None:
        raise NerfroError("set out= to the folder that takes the data set")
    if config.images is None and not (config.write_board and config.target != "colmap"):
        raise NerfroError("set images= to the folder of the photographs; or write_board=true for a board to print")
    if config.test_every < 2:
        raise NerfroError(f"test_every={config.test_every} leaves nothing to train on; take 2 or more")
    for name in ("columns", "rows", "size", "marker"):
        if config[name] is not None and not config[name] > 0:
            raise NerfroError(f"{name}={config[name]} is not allowed; it must be positive")
    if config.intrinsics is None:
        if config.distortion:
            raise NerfroError("distortion= belongs to a lens that is known; give intrinsics=[fx,fy,cx,cy] as well")
        return None
    if len(config.intrinsics) != 4 or min(config.intrinsics) <= 0 or len(config.distortion or ()) not in (0, 4):
        raise NerfroError(
            f"intrinsics={config.intrinsics}, distortion={config.distortion} are no lens; give fx, fy, cx, cy in "
            "pixels, and k1, k2, p1, p2 or nothing"
        )
    fx, fy, cx, cy = config.intrinsics
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), tuple(config.distortion or ()))


def make_target(config: DictConfig) -> Target:
    """The board that the options describe.

    Raises:
        NerfroError: there is no such board, or what finds it is not installed.
    """
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


def _write_board(config: DictConfig, target: Target | None, out: Path) -> None:
    if target is None:
        raise NerfroError("target=colmap has no board to write; choose target=apriltag or target=charuco")
    refuse_existing([out / "board.pdf"], config.overwrite)
    files = print_sheets(target.sheets(), out)
    print(f"wrote {files[0]} ({len(files) - 1} pages, in true size if the unit is a metre) and the pages as PNG")


def _list_photographs(folder: Path) -> tuple[list[Path], tuple[int, int]]:
    """The photographs by name, and their size.

    Raises:
        NerfroError: there are none, one cannot be read, sizes differ, or two would share a mask's name.
    """
    images = list_images(folder)
    repeated = [stem for stem, count in Counter(image.stem for image in images).items() if count > 1]
    if repeated:
        raise NerfroError(f"{folder} holds several images called {repeated[0]}; keep one of each name")
    shapes = {image: read_rgb(image, "drop").shape[1::-1] for image in track(images, "reading")}
    (size, _), *others = Counter(shapes.values()).most_common()
    if others:
        odd = next(image for image in images if shapes[image] != size)
        raise NerfroError(
            f"image {odd} has {shapes[odd][0]}x{shapes[odd][1]} pixels but most have {size[0]}x{size[1]}; all must be "
            "of one lens and size: turn or remove it"
        )
    return images, size


def luminance(image: Path) -> UInt8[np.ndarray, "H W"]:
    """Luminance of an image, linear in light, its brightest thousandth white.

    A pixel on an edge averages light, and sRGB's curve shows half the light as more than half a level. The edges of
    what is bright are then found too far outside, those of tags by 0.2 to 0.3 pixels.
    """
    light = to_linear(read_rgb(image, "drop")) @ _LUMINANCE
    white = max(float(np.quantile(light, 0.999)), 1 / 255)
    return np.uint8(np.rint(255 * np.minimum(light / white, 1.0)))


def _outside(sighting: Sighting, mask: Path | None) -> Sighting:
    """The features that are not seen through the object, or cut by it."""
    if mask is None or len(sighting.points) == 0:
        return sighting
    inside = read_mask(mask) > 0.5
    columns, rows = np.clip(sighting.pixels.astype(int), 0, np.array(inside.shape[::-1]) - 1).T
    return sighting.only(~np.isin(sighting.features, sighting.features[inside[rows, columns]]))


def _find_model(
    config: DictConfig, images: list[Path], masks: list[Path | None], out: Path, given: Intrinsics | None
) -> Path:
    """The folder of the COLMAP model, which is made where there is none."""
    if config.model is not None:
        return Path(config.model).expanduser()
    folder = images[0].parent
    for candidate in (root / name for root in (folder.parent, folder) for name in _MODEL_FOLDERS):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            print(f"taking the model {candidate}")
            return candidate
    refuse_existing([out / "sparse"], config.overwrite)
    num_masks = sum(mask is not None for mask in masks)
    print(f"no COLMAP model: making one from {len(images)} images, {num_masks} of them with masks of the object")
    return reconstruct(images, masks, out / "sparse", config.lens, given)


def split_views(names: list[str], every: int) -> dict[str, list[str]]:
    """Names by split: each `every`-th from the first is for test, each `every`-th from half way on for validation."""
    splits: dict[str, list[str]] = {split: [] for split in _SPLITS}
    for number, name in enumerate(sorted(names)):
        place = number % every
        splits["test" if place == 0 else "val" if place == every // 2 and every > 2 else "train"].append(name)
    return splits


def _report(calibration: Calibration, config: DictConfig, feature: str) -> None:
    print(f"reprojection error in pixels (rms), and {feature}, by image:")
    for name, pose in sorted(calibration.poses.items()):
        print(f"  {pose.error:6.3f}  {pose.num_features:4d}  {name}")
    errors = np.array([pose.error for pose in calibration.poses.values()])
    print(f"  {np.nanmean(errors):6.3f}  mean; {np.nanmax(errors):.3f} largest")
    for name, reason in sorted(calibration.skipped.items()):
        print(f"  skipped: {name}: {reason}")
    if calibration.num_outliers:
        print(f"{calibration.num_outliers} points were taken out as wrong: misread, or seen through the object")
    lens = calibration.intrinsics
    focal, deviation = lens.matrix[0, 0], lens.focal_deviation
    print(
        f"fx={focal:.2f} fy={lens.matrix[1, 1]:.2f} cx={lens.matrix[0, 2]:.2f} cy={lens.matrix[1, 2]:.2f} "
        f"distortion={[round(number, 5) for number in lens.distortion]}"
        + (f"; standard deviation of fx {deviation:.2f}" if deviation is not None else "")
    )
    if np.nanmean(errors) > _GOOD_ERROR and config.lens == "pinhole" and not config.intrinsics:
        _warn("the error is large; a lens that distorts wants lens=radial or lens=opencv")
    if deviation is not None and deviation > _GOOD_FOCAL * focal:
        _warn("the focal length is uncertain; photograph the board also at a slant, and from near and far")


def _write(
    out: Path,
    images: list[Path],
    size: tuple[int, int],
    calibration: Calibration,
    splits: dict[str, list[str]],
    target: str,
    quads: list[Float[np.ndarray, "4 3"]],
    points: Float[np.ndarray, "P 3"],
) -> None:
    """The data set (see docs/data.md), the report and the plot."""
    files = {image.name: image for image in images}
    lens = calibration.intrinsics
    document: dict[str, object] = {"cam_mat": lens.matrix.tolist(), "w": size[0], "h": size[1]}
    if lens.distortion:
        document["dist"] = list(lens.distortion)
    written = []
    for split, names in splits.items():
        path = out / f"transforms_{split}.json"
        if not names:
            path.unlink(missing_ok=True)  # of an earlier calibration
            continue
        frames = []
        for name in names:
            matrix = [*calibration.poses[name].camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": _relative(files[name], out), "transform_matrix": matrix})
        write_atomically(path, json.dumps(document | {"frames": frames}, indent=1) + "\n")
        written.append(f"{path} ({len(names)} views)")
    report = {
        "target": target,
        **document,
        "focal_deviation": lens.focal_deviation,
        "images": {
            name: {"split": split, "error": round(pose.error, 4), "features": pose.num_features}
            for split, names in splits.items()
            for name, pose in ((name, calibration.poses[name]) for name in names)
        },
        "skipped": calibration.skipped,
        "points_taken_out": calibration.num_outliers,
    }
    write_atomically(out / _REPORT, json.dumps(report, indent=1) + "\n")
    poses = list(calibration.poses.values())
    slopes = 0.5 * size[0] / lens.matrix[0, 0], 0.5 * size[1] / lens.matrix[1, 1]
    picture = draw_cameras(
        np.stack([pose.camera_to_world for pose in poses]),
        np.nan_to_num([pose.error for pose in poses]),
        slopes,
        quads,
        points,
    )
    write_atomically(out / _PLOT, picture)
    print(f"wrote {', '.join([*written, str(out / _REPORT), str(out / _PLOT)])}")


def _relative(file: Path, folder: Path) -> str:
    """A file's path from a folder; through a link within the folder, whose place in it says where masks are."""
    file, folder = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    if not file.is_relative_to(folder):
        file, folder = file.resolve(), folder.resolve()
    return Path(os.path.relpath(file, folder)).as_posix()


def _next_command(out: Path, calibration: Calibration, seen: Float[np.ndarray, "P 3"], has_masks: bool) -> list[str]:
    """What comes after calibration, with bounds that hold all that the target or the points span."""
    centres = np.stack([pose.camera_to_world[:, 3] for pose in calibration.poses.values()])
    bounds = []
    if len(seen):
        distances = np.linalg.norm(centres[:, None] - seen[None, :: max(1, len(seen) // 2000)], axis=-1)
        near, far = 0.5 * np.quantile(distances, 0.001), 1.5 * np.quantile(distances, 0.999)
        bounds = [f"data.near={near:.3g}", f"data.far={far:.3g}"]
    options = ["data=opencv", f"data.root={out}", *bounds]
    if has_masks:
        return ["python", "-m", "nerfro.preprocess", *options, "medium.ior=1.33"]
    return ["python", "-m", "nerfro.mask", *options, "outlines={NAME:[LEFT,TOP,RIGHT,BOTTOM]}"]


def _warn(message: str) -> None:
    print(f"nerfro: warning: {message}")


if __name__ == "__main__":
    main()
