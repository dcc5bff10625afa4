"""Page of a run, `index.html`: costs, scores, training curve, best and worst view, files and next commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.paths import ASSETS_DIR
from nerfro.core.progress import duration
from nerfro.evaluation.results import RunMetrics
from nerfro.files.atomic import write_atomically
from nerfro.files.templates import fill_template

CurvePoint = tuple[int, float, float]
"""Step, seconds since the start of the training, and loss."""


def write_run_page(
    folder: Path,
    title: str,
    costs: tuple[int, float],
    curve: Sequence[CurvePoint],
    scores: RunMetrics | None,
    split: str,
) -> None:
    """Write `index.html` into the folder of a run.

    Args:
        folder: folder of the run, with its other files.
        title: heading of the page.
        costs: number of steps, and seconds of training.
        curve: points of the training curve.
        scores: scores of the views of `split`; None without evaluation.
        split: name of the evaluated split.
    """
    figures, views = {"training": duration(costs[1]), "steps": f"{costs[0]:,}"}, []
    if scores is not None:
        means = {name: mean for name, mean in scores.result.means().items() if mean is not None}
        figures |= {name.upper(): f"{mean:.{2 if name == 'psnr' else 3}f}" for name, mean in means.items()}
        numbered = [(view.score("psnr"), number) for number, view in enumerate(scores.result.views)]
        ranked = sorted((psnr, number) for psnr, number in numbered if psnr is not None)
        for label, (psnr, number) in zip(("worst", "best"), (ranked[:1] + ranked[-1:]), strict=False):
            views.append((label, f"images/{split}_{number:03d}.png", f"{psnr:.1f}"))
    names = ("metrics.md", "metrics.csv", "metrics.json", "config.yaml", "run.json", "cameras.json")
    checkpoint = as_overrides({"checkpoint": folder})
    film = as_overrides({"checkpoint": folder, "path": "orbit", "out": folder / "orbit"})
    page = fill_template(
        ASSETS_DIR / "_run" / "index.html.jinja",
        title=title,
        figures=figures,
        curve=_drawn(curve) if len(curve) > 1 else None,
        views=views,
        split=split,
        files=[name for name in names if (folder / name).is_file()],
        commands=[command_line("view", checkpoint), command_line("render", film)],
    )
    write_atomically(folder / "index.html", page)


def _drawn(curve: Sequence[CurvePoint]) -> dict[str, str]:
    """Return the labels and the polyline of a curve, in a box of 1000 x 100."""
    logs = [math.log(max(loss, 1e-9)) for *_, loss in curve]
    low, high, end = min(logs), max(logs), max(curve[-1][1], 1e-9)
    points = [
        f"{1000 * seconds / end:.1f},{98 - 96 * (log - low) / max(high - low, 1e-9):.1f}"
        for (_, seconds, _), log in zip(curve, logs, strict=True)
    ]
    labels = {"lowest": math.exp(low), "highest": math.exp(high), "first": curve[0][2], "last": curve[-1][2]}
    return {name: f"{loss:.3g}" for name, loss in labels.items()} | {
        "points": " ".join(points),
        "duration": duration(end),
    }
