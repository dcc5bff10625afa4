"""Writing a calibration as a data set, with a plot of the cameras."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.cameras import up_direction
from nerfro.core.paths import relative_path
from nerfro.files.atomic import write_atomically, write_json
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.normals import axes_along
from nerfro.poses.calibration import Calibration

SPLITS = ("train", "val", "test")
REPORT, PLOT = "calibration.json", "cameras.png"
FILES = (*(f"transforms_{split}.json" for split in SPLITS), REPORT, PLOT)


def split_views(names: list[str], every: int) -> dict[str, list[str]]:
    """Split names into training, validation and test: every `every`-th name is for test, as many for validation."""
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    for number, name in enumerate(sorted(names)):
        rank = number % every
        splits["test" if rank == 0 else "val" if rank == every // 2 and every > 2 else "train"].append(name)
    return splits


def write_calibrated(
    out: Path,
    images: list[Path],
    size: tuple[int, int],
    calibration: Calibration,
    splits: dict[str, list[str]],
    target: str,
    shown: tuple[list[Float[np.ndarray, "4 3"]], Float[np.ndarray, "points 3"]],
    bounds: dict[str, float],
) -> list[str]:
    """Write the data set (see docs/guides/data_formats.md), calibration.json and cameras.png.

    Args:
        out: folder of the data set.
        images: the photographs.
        size: width and height, in pixels.
        calibration: estimated lens and poses.
        splits: image names by split.
        target: name of the calibration target.
        shown: corners of the sheets of the board and scene points, for the plot.
        bounds: bounds `near` and `far` of the rays; empty if unknown.

    Returns:
        Descriptions of the written files.
    """
    files = {image.name: image for image in images}
    lens = calibration.intrinsics
    document: dict[str, object] = {"cam_mat": lens.matrix.tolist(), "w": size[0], "h": size[1], **bounds}
    if lens.distortion:
        document["dist"] = list(lens.distortion)
    written = []
    for split, names in splits.items():
        path = out / f"transforms_{split}.json"
        if not names:
            path.unlink(missing_ok=True)  # left by an earlier calibration
            continue
        frames = []
        for name in names:
            matrix = [*calibration.poses[name].camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": relative_path(files[name], out), "transform_matrix": matrix})
        write_json(path, document | {"frames": frames})
        written.append(f"{path} ({len(names)} views)")
    report = {
        "target": target,
        **document,
        "focal_deviation": lens.focal_deviation,
        "images": {
            name: {
                "split": split,
                "error": round(pose.error, 4) if pose.num_observations else None,
                "num_observations": pose.num_observations,
            }
            for split, names in splits.items()
            for name, pose in ((name, calibration.poses[name]) for name in names)
        },
        "skipped": calibration.skipped,
        "num_outliers": calibration.num_outliers,
    }
    write_json(out / REPORT, report)
    poses = list(calibration.poses.values())
    matrices, errors = np.stack([pose.camera_to_world for pose in poses]), [pose.error for pose in poses]
    write_atomically(out / PLOT, _plot_cameras(matrices, np.nan_to_num(errors), *shown))
    return [*written, str(out / REPORT), str(out / PLOT)]


def ray_range(calibration: Calibration, seen: Float[np.ndarray, "points 3"]) -> dict[str, float]:
    """Return bounds `near` and `far` that enclose all points for all cameras; none without points."""
    if len(seen) == 0:
        return {}
    centres = np.stack([pose.camera_to_world[:, 3] for pose in calibration.poses.values()])
    distances = np.linalg.norm(centres[:, None] - seen[None, :: max(1, len(seen) // 2000)], axis=-1)
    near, far = 0.5 * np.quantile(distances, 0.001), 1.5 * np.quantile(distances, 0.999)
    return {"near": float(f"{near:.3g}"), "far": float(f"{far:.3g}")}


def _plot_cameras(
    poses: Float[np.ndarray, "V 3 4"],
    errors: Float[np.ndarray, "V"],
    quads: Sequence[Float[np.ndarray, "4 3"]],
    points: Float[np.ndarray, "points 3"],
) -> bytes:
    """Plot the cameras from the side and from above, as arrows along the optical axes.

    Without a board, the axes of the world are arbitrary, and the up direction is that of the cameras.

    Args:
        poses: camera-to-world matrices in OpenCV's axes.
        errors: reprojection errors, in pixels, shown as colours.
        quads: corners of the sheets of the board.
        points: scene points; outliers are left out.

    Returns:
        The plot as a PNG file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if len(points):
        low, high = np.quantile(points, (0.02, 0.98), axis=0)
        points = points[((points >= low) & (points <= high)).all(1)][:: -(-len(points) // 4000)]
    axes_shown = np.eye(3) if quads else axes_along(up_direction(torch.from_numpy(-poses[:, :, 1])).numpy())
    cameras, points = np.einsum("ij,vjk->vik", axes_shown, poses), points @ axes_shown.T
    focus = nearest_point(cameras[:, :, 3], cameras[:, :, 2])
    figure = Figure(figsize=(13, 6.5), layout="constrained", dpi=110)
    sides = ("from the side", 0, 2), ("from above", 0, 1)
    for axes, (title, across, up) in zip(figure.subplots(1, 2), sides, strict=True):
        for quad in quads:
            axes.fill(quad[:, across], quad[:, up], facecolor="0.75", edgecolor="0.2")
        axes.plot(points[:, across], points[:, up], ".", markersize=1, color="0.4")
        axes.plot(focus[across], focus[up], "rx", markersize=12, label="point nearest to the optical axes")
        ends = (cameras[:, axis, column] for column in (3, 2) for axis in (across, up))
        arrows = axes.quiver(*ends, errors, clim=(0, max(0.5, float(errors.max()))), angles="xy", width=0.004)
        axes.set(title=title, aspect="equal")
        axes.margins(0.1)
        axes.legend(loc="upper right")
    figure.colorbar(arrows, ax=figure.axes, shrink=0.6, label="reprojection error, pixels (rms)")
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content)
    return content.getvalue()
