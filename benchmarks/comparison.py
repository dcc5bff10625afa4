"""The README's table and picture grid: every method on the embedded scene, trained for the same time, one by one.

    python benchmarks/comparison.py 00:00:04:00

writes outputs/comparison/<method>/ (finished runs are kept) and docs/images/comparison.png, and prints the table.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from nerfro.evaluation.image_grid import ImageRow, image_grid, most_different_crop
from nerfro.evaluation.results import METRICS, RunMetrics, read_metrics_json
from nerfro.evaluation.tables import Column, Row, Table, to_markdown
from nerfro.files.images import load_png, save_png
from nerfro.paths import ASSETS_DIR

METHODS = {
    "mipnerf": "mip-NeRF",
    "mipnerf_sky": "mip-NeRF + sky",
    "ablation_noH": "refractive w/o H",
    "ablation_noBD": "refractive w/o BD",
    "refractive": "refractive",
}
SHOWN = ("mipnerf", "refractive", "ablation_noH", "ablation_noBD")
VIEWS = (1, 3)
ROOT = Path(__file__).resolve().parent.parent
RUNS = ROOT / "outputs" / "comparison"


def main() -> None:
    """Train what is not trained yet, then draw and tabulate."""
    max_time = sys.argv[1] if len(sys.argv) > 1 else "00:00:04:00"
    for name in METHODS:
        folder = RUNS / name
        if not (folder / "metrics.json").exists():
            command = [sys.executable, "-m", "nerfro.train", f"+experiment={name}", f"hydra.run.dir={folder}"]
            subprocess.run([*command, f"trainer.max_time={max_time}"], check=True, cwd=ROOT)
    metrics = {name: read_metrics_json(RUNS / name / "metrics.json") for name in METHODS}
    print(to_markdown(table(metrics)))
    save_png(ROOT / "docs" / "images" / "comparison.png", grid(metrics))


def table(metrics: dict[str, RunMetrics]) -> Table:
    """Mean scores, optimiser steps and rays per second of every method."""
    shown = [metric for metric in METRICS if metric.name in ("psnr", "ssim", "lpips")]
    columns = (
        *(Column(metric.title, metric.better, metric.decimals) for metric in shown),
        Column("steps", None, 0),
        Column("rays/s", None, 0),
    )
    rows = [
        Row(METHODS[name], (*(run.result.mean(metric.name) for metric in shown), run.steps, run.rays_per_second))
        for name, run in metrics.items()
    ]
    reasons = [(metric, run.result.notes.get(metric.name)) for metric in shown for run in metrics.values()]
    notes = dict.fromkeys(f"{metric.title} n/a: {reason}" for metric, reason in reasons if reason is not None)
    return Table("Embedded torus, 20 test views", "method", columns, tuple(rows), mark="best", notes=tuple(notes))


def grid(metrics: dict[str, RunMetrics]):
    """Some test views by the methods of the paper's figure."""
    rows = []
    for view in VIEWS:
        reference = load_png(ASSETS_DIR / "torus" / "test" / f"r_{view:03d}.png")
        predictions = [load_png(RUNS / name / "images" / f"test_{view:03d}.png") for name in SHOWN]
        scores = [f"{metrics[name].result.views[view].scores['psnr']:.2f} dB" for name in SHOWN]
        crop = most_different_crop(reference, predictions, 32)
        rows.append(ImageRow(reference, predictions, captions=scores, crops=[crop]))
    return image_grid(rows, ["reference", *(METHODS[name] for name in SHOWN)])


if __name__ == "__main__":
    main()
