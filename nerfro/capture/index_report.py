"""From photographs and a surface to its index: the search, its figures and its curve."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nerfro.capture.index_search import Estimate, find_indices
from nerfro.capture.surroundings import Around
from nerfro.cli import warn
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.media.solid import Solid
from nerfro.progress import bar

INDEX, CURVE = "index.json", "index.png"


def search_index(around: Around, medium: Solid, folder: Path) -> Estimate:
    """Find the indices of a medium's bodies; write index.json and index.png, and print what was found.

    Args:
        around: what photographs show.
        medium: the bodies.
        folder: to write to.
    """
    through, surroundings = around.through, around.surroundings
    with bar("search") as told:
        found = find_indices(medium, through, surroundings, told)
    for name, value, error, bend in zip(found.names, found.values, found.standard_errors, found.curvature, strict=True):
        print(f"{name}: {value:.5g} +- {error:.2g} (views resampled); curvature of the error {bend:.3g}")
    for doubt in found.doubts:
        warn(f"the pictures do not tell the {' and '.join(found.names)}: {doubt}; look at {CURVE}")
    _draw(found, folder / CURVE)
    figures = {"ior": _rounded(found.values), "standard_error": _rounded(found.standard_errors), "doubts": found.doubts}
    write_atomically(folder / INDEX, json.dumps(figures, indent=1) + "\n")
    return found


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(x), 5) for x in values]


def _draw(found: Estimate, file: Path) -> None:
    """Write the error against each number, the lowest over the others': from afar, and near the best."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(found.names)
    figure = Figure(figsize=(11, 4 * count), layout="constrained", dpi=110)
    for number, axes in enumerate(figure.subplots(count, 2, squeeze=False)):
        best, error = found.values[number], found.standard_errors[number]
        for plot, tried in zip(axes, (found.wide, found.close), strict=True):
            values = np.unique(tried[:, number])
            plot.plot(values, [tried[tried[:, number] == value, -1].min() for value in values], "o-", markersize=4)
            plot.axvline(best, color="tab:red", linewidth=1)
            plot.axvspan(best - error, best + error, color="tab:red", alpha=0.2)
            plot.set_xlabel(found.names[number])
            plot.set_ylabel("robust error")
        axes[0].axhline(found.unrelated, color="grey", linestyle=":", label="unrelated colours")
        axes[0].legend()
        axes[1].set_title(f"{best:.5g} ± {error:.2g}")
    with atomic_file(file) as stream:
        FigureCanvasAgg(figure).print_png(stream)
