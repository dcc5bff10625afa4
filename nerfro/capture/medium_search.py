"""Construction of the medium from a surface, with a search for unknown refractive indices, its report and plot."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from nerfro.capture.index_search import Estimate, find_indices
from nerfro.capture.preprocess_options import CURVE, INDEX, Request, build_medium, index_settings
from nerfro.capture.surroundings import Observations
from nerfro.cli import warn
from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.media.base import Medium
from nerfro.media.solid import Solid
from nerfro.progress import bar


@dataclass(frozen=True)
class FoundMedium:
    """A medium with all indices.

    Attributes:
        medium: the medium.
        index_settings: options of the indices that were searched.
        is_doubtful: whether the photographs do not determine these indices.
    """

    medium: Medium
    index_settings: dict[str, object] = field(default_factory=dict)
    is_doubtful: bool = False


def find_medium(
    request: Request, observations: Observations, location: str, settings: dict[str, object]
) -> FoundMedium:
    """Build the medium with a surface, and search the indices if they are not given.

    Args:
        request: options of the command.
        observations: observations of the object and its surroundings.
        location: file of the surface.
        settings: options of the surface (see `surface_settings`).
    """
    if not request.searches_index:
        return FoundMedium(build_medium(request, settings, location, {}))
    num_bodies = 1 + len(request.config.medium.get("inner_meshes", []))
    medium = build_medium(request, settings, location, index_settings([1.5] * num_bodies))
    if not isinstance(medium, Solid):
        raise NerfroError("the index of this type of medium cannot be searched for; set medium.ior=, or medium=object")
    found = _search_index(observations, medium, request.folder)
    options: dict[str, object] = {f"medium.{name}": value for name, value in index_settings(found.values).items()}
    return FoundMedium(medium.with_indices(torch.from_numpy(found.values)), options, bool(found.doubts))


def _search_index(observations: Observations, medium: Solid, folder: Path) -> Estimate:
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
