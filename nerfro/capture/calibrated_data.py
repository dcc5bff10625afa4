"""The data set that a calibration becomes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.capture.calibration import Calibration
from nerfro.capture.camera_plot import draw_cameras
from nerfro.files.atomic import write_atomically

SPLITS = ("train", "val", "test")
REPORT, PLOT = "calibration.json", "cameras.png"
FILES = (*(f"transforms_{split}.json" for split in SPLITS), REPORT, PLOT)


def split_views(names: list[str], every: int) -> dict[str, list[str]]:
    """Names by split: each `every`-th from the first is for test, each `every`-th from half way on for validation."""
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    for number, name in enumerate(sorted(names)):
        place = number % every
        splits["test" if place == 0 else "val" if place == every // 2 and every > 2 else "train"].append(name)
    return splits


def write_calibrated(
    out: Path,
    images: list[Path],
    size: tuple[int, int],
    calibration: Calibration,
    splits: dict[str, list[str]],
    target: str,
    quads: list[Float[np.ndarray, "4 3"]],
    points: Float[np.ndarray, "P 3"],
) -> list[str]:
    """Write the data set (see docs/data.md), calibration.json and cameras.png.

    Args:
        out: the folder.
        images: all photographs.
        size: of them, width and height.
        calibration: what was found.
        splits: names by split.
        target: what was calibrated with.
        quads: the board's sheets, for the plot.
        points: of the scene, for the plot.

    Returns:
        What was written, in words.
    """
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
            frames.append({"file_path": relative(files[name], out), "transform_matrix": matrix})
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
    write_atomically(out / REPORT, json.dumps(report, indent=1) + "\n")
    poses = list(calibration.poses.values())
    slopes = 0.5 * size[0] / lens.matrix[0, 0], 0.5 * size[1] / lens.matrix[1, 1]
    picture = draw_cameras(
        np.stack([pose.camera_to_world for pose in poses]),
        np.nan_to_num([pose.error for pose in poses]),
        slopes,
        quads,
        points,
    )
    write_atomically(out / PLOT, picture)
    return [*written, str(out / REPORT), str(out / PLOT)]


def relative(file: Path, folder: Path) -> str:
    """A file's path from a folder; through a link within the folder, whose place in it says where masks are."""
    file, folder = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    if not file.is_relative_to(folder):
        file, folder = file.resolve(), folder.resolve()
    return Path(os.path.relpath(file, folder)).as_posix()


def ray_range(calibration: Calibration, seen: Float[np.ndarray, "P 3"]) -> list[str]:
    """Options `data.near` and `data.far` that hold all that the target or the points span; none without points."""
    if len(seen) == 0:
        return []
    centres = np.stack([pose.camera_to_world[:, 3] for pose in calibration.poses.values()])
    distances = np.linalg.norm(centres[:, None] - seen[None, :: max(1, len(seen) // 2000)], axis=-1)
    near, far = 0.5 * np.quantile(distances, 0.001), 1.5 * np.quantile(distances, 0.999)
    return [f"data.near={near:.3g}", f"data.far={far:.3g}"]
