"""Writing a calibration as a data set, with a plot of the cameras."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.capture.calibration import Calibration
from nerfro.files.atomic import write_atomically

SPLITS = ("train", "val", "test")
REPORT, PLOT = "calibration.json", "cameras.png"
FILES = (*(f"transforms_{split}.json" for split in SPLITS), REPORT, PLOT)
# Size of a drawn camera, as a fraction of the median distance of the cameras from the centre of the scene.
_CAMERA_SIZE = 0.08
_MAX_POINTS = 4000
_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def split_views(names: list[str], every: int) -> dict[str, list[str]]:
    """Split names into training, validation and test: every `every`-th name is for test, as many for validation."""
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
    options: list[str],
) -> list[str]:
    """Write the data set (see docs/data.md), calibration.json and cameras.png.

    Args:
        out: folder of the data set.
        images: the photographs.
        size: width and height, in pixels.
        calibration: estimated lens and poses.
        splits: image names by split.
        target: name of the calibration target.
        quads: corners of the sheets of the board, for the plot.
        points: scene points, for the plot.
        options: command-line options for the following commands, such as data.near and data.far.

    Returns:
        Descriptions of the written files.
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
            path.unlink(missing_ok=True)  # left by an earlier calibration
            continue
        frames = []
        for name in names:
            matrix = [*calibration.poses[name].camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": relative(files[name], out), "transform_matrix": matrix})
        write_atomically(path, json.dumps(document | {"frames": frames}, indent=1) + "\n")
        written.append(f"{path} ({len(names)} views)")
    report = {
        "target": target,
        "options": options,
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
    matrices, errors = np.stack([pose.camera_to_world for pose in poses]), [pose.error for pose in poses]
    write_atomically(out / PLOT, _draw_cameras(matrices, np.nan_to_num(errors), slopes, quads, points))
    return [*written, str(out / REPORT), str(out / PLOT)]


def relative(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder; links inside the folder are kept, since masks lie beside them."""
    file, folder = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    if not file.is_relative_to(folder):
        file, folder = file.resolve(), folder.resolve()
    return Path(os.path.relpath(file, folder)).as_posix()


def ray_range(calibration: Calibration, seen: Float[np.ndarray, "P 3"]) -> list[str]:
    """Return options `data.near` and `data.far` that enclose all points for all cameras; none without points."""
    if len(seen) == 0:
        return []
    centres = np.stack([pose.camera_to_world[:, 3] for pose in calibration.poses.values()])
    distances = np.linalg.norm(centres[:, None] - seen[None, :: max(1, len(seen) // 2000)], axis=-1)
    near, far = 0.5 * np.quantile(distances, 0.001), 1.5 * np.quantile(distances, 0.999)
    return [f"data.near={near:.3g}", f"data.far={far:.3g}"]


def _draw_cameras(
    poses: Float[np.ndarray, "V 3 4"],
    errors: Float[np.ndarray, "V"],
    slopes: tuple[float, float],
    quads: Sequence[Float[np.ndarray, "4 3"]],
    points: Float[np.ndarray, "P 3"],
) -> bytes:
    """Plot the cameras as pyramids, coloured by reprojection error, from the side and from above.

    Args:
        poses: camera-to-world matrices in OpenCV's axes.
        errors: reprojection errors, in pixels.
        slopes: half the width and height of the image at unit depth.
        quads: corners of the sheets of the board.
        points: scene points.

    Returns:
        The plot as a PNG file.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    centres = poses[:, :, 3]
    seen = np.concatenate([*quads, points]) if quads or len(points) else centres
    middle = np.median(seen, axis=0)
    size = _CAMERA_SIZE * float(np.median(np.linalg.norm(centres - middle, axis=1)))
    norm = Normalize(0, max(0.5, float(errors.max())))
    colours = colormaps["viridis"](norm(errors))
    half = np.array(slopes) / max(slopes) * 0.5 * size
    frame = np.array([[x * half[0], y * half[1], 0.5 * size / max(slopes)] for x, y in _CORNERS])
    # Outliers among the points of a reconstruction would otherwise determine the limits of the axes.
    core = [np.quantile(points, (0.02, 0.98), axis=0)] if len(points) else []
    shown = np.concatenate([centres, *quads, *core])
    low, high = shown.min(0) - size, shown.max(0) + size
    figure = Figure(figsize=(13, 6.5), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    for place, (elevation, azimuth) in enumerate(((22, -60), (90, -90)), 1):
        axes = figure.add_subplot(1, 2, place, projection="3d")
        axes.set_proj_type("ortho")
        axes.view_init(elevation, azimuth)
        for pose, colour in zip(poses, colours, strict=True):
            corners = frame @ pose[:, :3].T + pose[:, 3]
            lines = [(pose[:, 3], corner) for corner in corners]
            lines += [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
            axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=0.9))
        if quads:
            style = {"facecolors": "0.75", "edgecolors": "0.2", "linewidths": 0.6, "alpha": 0.8}
            axes.add_collection3d(Poly3DCollection(quads, **style))
        chosen = points[:: -(-len(points) // _MAX_POINTS) or 1]
        chosen = chosen[((chosen >= low) & (chosen <= high)).all(1)] if len(chosen) else chosen
        axes.scatter(*chosen.T, s=1, c="0.4")
        for i, axis in enumerate("xyz"):
            getattr(axes, f"set_{axis}lim")(low[i], high[i])
            getattr(axes, f"set_{axis}label")(axis)
        axes.set_box_aspect(tuple(high - low), zoom=0.95)
        if elevation == 90:  # from above
            axes.set_zticks([])
            axes.set_zlabel("")
    scale = ScalarMappable(norm, "viridis")
    figure.colorbar(scale, ax=figure.axes, shrink=0.6, label="reprojection error, pixels (rms)")
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()
