"""Search of the refractive indices with progress bar, report file and plot of the error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nerfro.capture.index_search import Estimate, find_indices
from nerfro.capture.surroundings import Observations
from nerfro.cli import warn
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.media.solid import Solid
from nerfro.progress import bar

INDEX, CURVE = "index.json", "index.png"


def search_index(observations: Observations, medium: Solid, folder: Path) -> Estimate:
    """Search the indices of the bodies of a medium, print the result, and write index.json and index.png.

    Args:
        observations: observations of the object and its surroundings.
        medium: the bodies.
        folder: output folder.
    """
    through, surroundings = observations.through, observations.surroundings
    with bar("search") as progress:
        found = find_indices(medium, through, surroundings, progress)
    for name, value, error in zip(found.names, found.values, found.standard_errors, strict=True):
        print(f"{name}: {value:.5g} +- {error:.2g} (standard error by resampling of the views)")
    for doubt in found.doubts:
        warn(f"the photographs do not determine the {' and '.join(found.names)}: {doubt}; look at {CURVE}")
    _plot(found, folder / CURVE)
    values, errors = ([round(float(x), 5) for x in each] for each in (found.values, found.standard_errors))
    figures = {"ior": values, "standard_error": errors, "doubts": found.doubts}
    write_atomically(folder / INDEX, json.dumps(figures, indent=1) + "\n")
    return found


def _plot(found: Estimate, file: Path) -> None:
    """Plot the error against each index, minimized over the other index, on the coarse and on the last fine grid."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(found.names)
    figure = Figure(figsize=(11, 4 * count), layout="constrained", dpi=110)
    for number, axes in enumerate(figure.subplots(count, 2, squeeze=False)):
        best, error = found.values[number], found.standard_errors[number]
        for plot, grid in zip(axes, (found.coarse, found.fine), strict=True):
            values = np.unique(grid[:, number])
            plot.plot(values, [grid[grid[:, number] == value, -1].min() for value in values], "o-", markersize=4)
            plot.axvline(best, color="tab:red", linewidth=1)
            plot.axvspan(best - error, best + error, color="tab:red", alpha=0.2)
            plot.set_xlabel(found.names[number])
            plot.set_ylabel("robust error")
        axes[0].axhline(found.unrelated, color="grey", linestyle=":", label="unrelated colours")
        axes[0].legend()
        axes[1].set_title(f"{best:.5g} ± {error:.2g}")
    with atomic_file(file) as stream:
        FigureCanvasAgg(figure).print_png(stream)
