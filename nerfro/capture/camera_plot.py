"""A picture of cameras in space, and of what they look at."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# Side of a drawn camera's picture, as a share of the cameras' median distance from the middle.
_CAMERA_SIZE = 0.08
_MAX_POINTS = 4000
_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def draw_cameras(
    poses: Float[np.ndarray, "V 3 4"],
    errors: Float[np.ndarray, "V"],
    slopes: tuple[float, float],
    quads: Sequence[Float[np.ndarray, "4 3"]],
    points: Float[np.ndarray, "P 3"],
) -> bytes:
    """Pyramids from each camera's centre, coloured by its reprojection error, from the side and from above.

    Args:
        poses: camera to world, OpenCV's axes.
        errors: of each pose, pixels.
        slopes: half the width and height of the image at unit depth.
        quads: the target's sheets.
        points: of the scene.

    Returns:
        PNG.
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
    # Stray points of a reconstruction lie anywhere.
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
            axes.add_collection3d(
                Poly3DCollection(quads, facecolors="0.75", edgecolors="0.2", linewidths=0.6, alpha=0.8)
            )
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
    figure.colorbar(
        ScalarMappable(norm, "viridis"), ax=figure.axes, shrink=0.6, label="reprojection error, pixels (rms)"
    )
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()
