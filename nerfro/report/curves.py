"""Training curves of several runs, drawn as small charts."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from nerfro.evaluation.results import TOO_LARGE
from nerfro.files.reading import reading

# File of the CSV logger of Lightning, see conf/logger/.
CURVES_FILE = Path("csv", "metrics.csv")
FIRST = ("train/psnr", "val/psnr", "loss/total")
MAX_POINTS = 200  # maximum number of points per line; a chart has only about 300 pixels
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a64d86", "#8a6d00", "#2a9fd6", "#444444", "#c2185b")  # by method

Curve = tuple[np.ndarray, np.ndarray]  # steps and values


@dataclass(frozen=True)
class Chart:
    """A quantity as a function of the optimization step.

    Attributes:
        name: name of the quantity.
        lines: index of the method and curve of each run that logged the quantity.
    """

    name: str
    lines: Sequence[tuple[int, Curve]]

    @property
    def logarithmic(self) -> bool:
        return self.name.startswith("loss/")

    @property
    def uri(self) -> str:
        """Drawing in SVG format as a data URI."""
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "nerfro", "font.size": 8}):
            figure = Figure(figsize=(3.4, 2.1), layout="tight")
            axes = figure.subplots()
            for method, (steps, values) in self.lines:
                marker = "o" if len(steps) == 1 else None
                axes.plot(steps, values, marker=marker, linewidth=1.2, color=COLOURS[method % len(COLOURS)])
            axes.set_xlim(left=0)
            axes.set_yscale("log" if self.logarithmic else "linear")
            axes.grid(axis="y", linewidth=0.5)
            file = io.BytesIO()
            figure.savefig(file, format="svg", metadata={"Date": None})
        return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()


def read_curves(folder: Path) -> dict[str, Curve]:
    """Read the logged quantities of a run by name; empty without a CSV log.

    Unreadable rows are skipped, such as the last row of an interrupted run.
    """
    points: dict[str, dict[int, float]] = {}
    path = folder / CURVES_FILE
    if path.is_file():
        with reading(path, advice="remove it"), path.open(newline="", encoding="utf-8", errors="replace") as file:
            for row in csv.DictReader(file):
                for name, text in row.items():
                    if name and (name in FIRST or name.startswith("loss/")):
                        step, value = _number(row.get("step")), _number(text)
                        if step is not None and value is not None:
                            points.setdefault(name, {})[int(step)] = value
    return {
        name: (np.array(sorted(values)), np.array([values[step] for step in sorted(values)]))
        for name, values in points.items()
    }


def make_charts(runs: Sequence[tuple[int, Mapping[str, Curve]]]) -> list[Chart]:
    """Make charts of PSNR and of all losses; `runs` contains method index and curves of each run.

    The axis of losses is logarithmic, so losses of zero are omitted.
    """
    names = {name for _, curves in runs for name in curves}
    charts = []
    for name in [*(name for name in FIRST if name in names), *sorted(names - set(FIRST))]:
        curves = [(method, curves[name]) for method, curves in runs if name in curves]
        if name.startswith("loss/"):
            curves = [(method, (steps[values > 0], values[values > 0])) for method, (steps, values) in curves]
        lines = [(method, _thin(*curve)) for method, curve in curves if len(curve[0]) > 0]
        if lines:
            charts.append(Chart(name, lines))
    return charts


def _thin(steps: np.ndarray, values: np.ndarray) -> Curve:
    """Average over groups of neighbouring points if there are more than `MAX_POINTS`."""
    if len(steps) <= MAX_POINTS:
        return steps, values
    groups = np.array_split(np.arange(len(steps)), MAX_POINTS)
    return np.array([steps[g].mean() for g in groups]), np.array([values[g].mean() for g in groups])


def _number(text: str | None) -> float | None:
    """Parse a number that can be drawn; returns None for any other text."""
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if abs(value) < TOO_LARGE else None
