"""From photographs and a surface to its index: the search with its progress, its figures and its curve."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nerfro.capture.index_search import IndexEstimate, find_index
from nerfro.capture.surroundings import Room, divide_pixels, learn_surroundings
from nerfro.cli import warn
from nerfro.data.base import Views
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.solid import Solid

INDEX, CURVE = "index.json", "index.png"


def search_index(views: Views, mesh: TriangleMesh, medium: Solid, room: bool | None, folder: Path) -> IndexEstimate:
    """Find the indices of a medium's bodies; write index.json and index.png, and print what was found.

    Args:
        views: photographs with poses.
        mesh: outer surface of the medium.
        medium: the bodies; its indices are set.
        room: whether the surroundings are near; None finds out.
        folder: to write to.
    """
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        learning, searching = progress.add_task("surroundings", total=1), progress.add_task("index", total=1)
        beside, through = divide_pixels(views, mesh)
        surroundings = learn_surroundings(beside, mesh, room, lambda done: progress.update(learning, completed=done))
        found = find_index(medium, through, surroundings, lambda done: progress.update(searching, completed=done))
    what = "near" if isinstance(surroundings.boundary, Room) else "far away"
    print(f"surroundings: {what}; {surroundings.unexplained:.1%} of other views' variance unexplained")
    names = ["index"] if len(found.iors) == 1 else [f"index of body {body + 1}" for body in range(len(found.iors))]
    for name, ior, error, bend in zip(names, found.iors, found.standard_errors, found.curvature, strict=True):
        print(f"{name}: {ior:.4f} +- {error:.4f} (views resampled); curvature of the error {bend:.3g}")
    for doubt in found.doubts:
        warn(f"the pictures do not tell the index: {doubt}; look at {CURVE}")
    figures = {
        "ior": [round(float(x), 5) for x in found.iors],
        "standard_error": [round(float(x), 5) for x in found.standard_errors],
        "doubts": found.doubts,
    }
    write_atomically(folder / INDEX, json.dumps(figures, indent=1) + "\n")
    draw_index(found, folder / CURVE)
    return found


def draw_index(found: IndexEstimate, file: Path) -> None:
    """Write the error against each body's index, the lowest over the others': from afar, and near the best."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    num_bodies = len(found.iors)
    figure = Figure(figsize=(11, 4 * num_bodies), layout="constrained", dpi=110)
    for body, axes in enumerate(figure.subplots(num_bodies, 2, squeeze=False)):
        ior, error = found.iors[body], found.standard_errors[body]
        for plot, tried in zip(axes, (found.wide, found.close), strict=True):
            values = np.unique(tried[:, body])
            plot.plot(values, [tried[tried[:, body] == value, -1].min() for value in values], "o-", markersize=4)
            plot.axvline(ior, color="tab:red", linewidth=1)
            plot.axvspan(ior - error, ior + error, color="tab:red", alpha=0.2)
            plot.set_xlabel("index" if num_bodies == 1 else f"index of body {body + 1}")
            plot.set_ylabel("robust error")
        axes[0].axhline(found.unrelated, color="grey", linestyle=":", label="unrelated colours")
        axes[0].legend()
        axes[1].set_title(f"{ior:.4f} ± {error:.4f}")
    with atomic_file(file) as stream:
        FigureCanvasAgg(figure).print_png(stream)
