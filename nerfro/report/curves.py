"""Training curves of several runs, drawn as small charts."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator

# File of the CSV logger of Lightning, see conf/logger/.
CURVES_FILE = Path("csv", "metrics.csv")
FIRST = ("train/psnr", "val/psnr", "loss/total")
MAX_POINTS = 200  # maximum number of points per line; a chart has only about 300 pixels

WIDTH, HEIGHT = 320, 200
LEFT, RIGHT, TOP, BOTTOM = 46, 10, 8, 22  # margins


@dataclass(frozen=True)
class Tick:
    """A grid line of a chart: position in chart units, and label."""

    at: float
    text: str


@dataclass(frozen=True)
class Line:
    """A polyline in the format of SVG `points`, with the index of its method. A single point is repeated."""

    method: int
    points: str
    single: bool


@dataclass(frozen=True)
class Chart:
    """A quantity as a function of the optimisation step.

    Attributes:
        name: name of the quantity.
        logarithmic: whether the vertical axis is logarithmic.
        x_ticks, y_ticks: grid lines.
        lines: one line per run that logged the quantity.
    """

    name: str
    logarithmic: bool
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Line, ...]


Curve = tuple[np.ndarray, np.ndarray]  # steps and values


def read_curves(folder: Path) -> dict[str, Curve]:
    """Read the logged quantities of a run by name; empty without a CSV log.

    Unreadable rows are skipped, such as the last row of an interrupted run.
    """
    points: dict[str, dict[int, float]] = {}
    if (folder / CURVES_FILE).is_file():
        with (folder / CURVES_FILE).open(newline="", encoding="utf-8") as file:
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


def draw_charts(runs: Sequence[tuple[int, Mapping[str, Curve]]]) -> list[Chart]:
    """Create charts of PSNR and of all losses; `runs` contains method index and curves of each run."""
    names = {name for _, curves in runs for name in curves}
    ordered = [name for name in FIRST if name in names] + sorted(names - set(FIRST))
    charts = (_chart(name, [(method, curves[name]) for method, curves in runs if name in curves]) for name in ordered)
    return [chart for chart in charts if chart.lines]


def _chart(name: str, curves: Sequence[tuple[int, Curve]]) -> Chart:
    logarithmic = name.startswith("loss/")
    if logarithmic:
        curves = [(method, (steps[values > 0], values[values > 0])) for method, (steps, values) in curves]
    kept = [(method, _thin(*curve)) for method, curve in curves if len(curve[0]) > 0]
    if not kept:
        return Chart(name, logarithmic, (), (), ())
    last = max(float(steps[-1]) for _, (steps, _) in kept)
    values = np.concatenate([values for _, (_, values) in kept])
    low, high = float(values.min()), float(values.max())
    if low == high:  # an empty range has no scale
        low, high = (low / 1.1, high * 1.1) if logarithmic else (low - 0.5, high + 0.5)
    if logarithmic:
        low, high = math.log10(low), math.log10(high)

    def x(step: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * step / max(last, 1.0)

    def y(value: float) -> float:
        height = (math.log10(value) if logarithmic else value) - low
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * height / (high - low)

    lines = []
    for method, (steps, heights) in kept:
        points = [f"{x(step):.1f},{y(value):.1f}" for step, value in zip(steps, heights, strict=True)]
        lines.append(Line(method, " ".join(points if len(points) > 1 else 2 * points), len(points) == 1))
    x_ticks = [v for v in MaxNLocator(4, integer=True).tick_values(0, last) if 0 <= v <= last]
    y_ticks = _log_ticks(10**low, 10**high) if logarithmic else MaxNLocator(5).tick_values(low, high)
    inside = [v for v in y_ticks if TOP - 0.5 <= y(v) <= HEIGHT - BOTTOM + 0.5]
    return Chart(
        name,
        logarithmic,
        tuple(Tick(x(v), f"{v / 1000:g}k" if v >= 1000 else f"{v:g}") for v in x_ticks),
        tuple(Tick(y(v), f"{v:.4g}") for v in inside),
        tuple(lines),
    )


def _thin(steps: np.ndarray, values: np.ndarray) -> Curve:
    """Average neighbouring points, so that at most `MAX_POINTS` remain."""
    if len(steps) <= MAX_POINTS:
        return steps, values
    groups = np.array_split(np.arange(len(steps)), MAX_POINTS)
    return np.array([steps[g].mean() for g in groups]), np.array([values[g].mean() for g in groups])


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten; if there are fewer than three, also twice and five times these."""
    for subs in ((1.0,), (1.0, 2.0, 5.0)):
        ticks = [float(v) for v in LogLocator(subs=subs, numticks=12).tick_values(low, high) if low <= v <= high]
        if len(ticks) >= 3:
            return ticks
    return [float(v) for v in MaxNLocator(4).tick_values(low, high) if v > 0]


def _number(text: str | None) -> float | None:
    """Parse a finite number; returns None for any other text."""
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
