"""The README's table and picture grid: every method on the embedded scene, trained for the same time on one core.

    python benchmarks/comparison.py [00:00:01:30] [--rows mipnerf refractive] [--core 1]

The time limit counts processor time of the whole process (see processor_time.py), and the process is pinned to one
core. A thread that traces rays therefore gets no time of its own, and other work on the machine does not matter.
Finished rows are kept in outputs/comparison/<time>/<method>/, so an interrupted comparison continues with the row that
was interrupted. Prints the table, and writes docs/images/comparison.png if all methods of the picture are there.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d

from nerfro.core.paths import ASSETS_DIR
from nerfro.evaluation.image_metrics import SQUARED_ERROR_LIMIT, image_metrics, squared_error_map
from nerfro.evaluation.results import RunMetrics, read_metrics_json
from nerfro.evaluation.tables import Column, Row, Table, to_markdown
from nerfro.files.images import load_png, magma, save_image, sheet

METHODS = {
    "mipnerf": "mip-NeRF",
    "mipnerf_sky": "mip-NeRF + sky",
    "ablation_noH": "refractive w/o H",
    "ablation_noBD": "refractive w/o BD",
    "refractive": "refractive",
}
SHOWN = ("mipnerf_sky", "refractive", "ablation_noH", "ablation_noBD")
VIEWS = (1, 3)
SQUARE = 32  # side of the enlarged square in pixels
ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Train the rows that are not finished, then print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("time", nargs="?", default="00:00:01:30", help="processor time of a row, DD:HH:MM:SS")
    parser.add_argument("--rows", nargs="+", choices=METHODS, default=list(METHODS), help="which methods; default: all")
    parser.add_argument("--core", type=int, help="number of the core; default: the last one that is allowed")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "comparison", help="folder of the runs")
    parser.add_argument("--picture", type=Path, default=ROOT / "docs" / "images" / "comparison.png")
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train, for all rows")
    given = parser.parse_args()
    out = given.out / given.time.replace(":", "")
    with one_core(given.core):
        for name in given.rows:
            train(name, out / name, [f"trainer.max_time={given.time}", *given.options])
    metrics = {name: read_metrics_json(out / name / "metrics.json") for name in given.rows}
    print(to_markdown(table(metrics)))
    if set(SHOWN) <= metrics.keys():
        save_image(given.picture, grid(out, metrics))


def train(name: str, folder: Path, options: list[str]) -> None:
    """Train a method, unless its folder holds a finished run; a run that was interrupted begins again."""
    if (folder / "metrics.json").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder = folder.resolve()
    # The run records its command, which does not depend on the place of the checkout.
    shown = folder.relative_to(ROOT) if folder.is_relative_to(ROOT) else folder
    command = [sys.executable, "benchmarks/processor_time.py", f"+experiment={name}", f"hydra.run.dir={shown}"]
    subprocess.run([*command, *options], check=True, cwd=ROOT)


@contextlib.contextmanager
def one_core(core: int | None) -> Iterator[None]:
    """Pin this process and those that it starts to one core, and give their libraries one thread."""
    allowed = os.sched_getaffinity(0)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    before = {name: os.environ.get(name) for name in threads}
    os.sched_setaffinity(0, {max(allowed) if core is None else core})
    os.environ.update(threads)
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def table(metrics: dict[str, RunMetrics]) -> Table:
    """Tabulate mean scores, optimizer steps and rays per second by the clock."""
    shown = image_metrics(["psnr", "ssim", "lpips"])
    columns = (
        *(Column(metric.title, metric.better, metric.decimals) for metric in shown.values()),
        Column("steps", None, 0),
        Column("rays/s", None, 0),
    )
    rows = [
        Row(METHODS[name], (*(run.result.mean(metric) for metric in shown), run.steps, run.rays_per_second))
        for name, run in metrics.items()
    ]
    reasons = [(metric, run.result.notes.get(name)) for name, metric in shown.items() for run in metrics.values()]
    notes = dict.fromkeys(f"{metric.title} n/a: {reason}" for metric, reason in reasons if reason is not None)
    return Table("Embedded torus, 20 test views", "method", columns, tuple(rows), medals=True, notes=tuple(notes))


def grid(runs: Path, metrics: dict[str, RunMetrics]) -> Image.Image:
    """Draw some test views by the methods of the paper's figure, the crop in which they differ most, and the errors."""
    images, captions = [], []
    for view in VIEWS:
        reference = load_png(ASSETS_DIR / "torus" / "test" / f"r_{view:03d}.png")
        predictions = [load_png(runs / name / "images" / f"test_{view:03d}.png") for name in SHOWN]
        errors = [squared_error_map(prediction, reference) for prediction in predictions]
        top, left = most_different_square(errors)
        square = slice(top, top + SQUARE), slice(left, left + SQUARE)
        images += [reference, *predictions, *(image[square] for image in (reference, *predictions))]
        images += [torch.ones_like(reference), *(magma(error, SQUARED_ERROR_LIMIT) for error in errors)]
        scores = [f"{metrics[name].result.views[view].scores['psnr']:.2f} dB" for name in SHOWN]
        captions += ["reference", *(METHODS[name] for name in SHOWN), "crop", *scores]
        captions += ["", *(f"squared error, 0 to {SQUARED_ERROR_LIMIT}" for _ in SHOWN)]
    return sheet(images, captions, 256, 1 + len(SHOWN))


def most_different_square(errors: Sequence[Float[Tensor, "H W"]]) -> tuple[int, int]:
    """Return the upper left corner of the square in which the squared errors of the methods vary most."""
    variance = torch.stack(list(errors)).var(0, correction=0).double()
    means = avg_pool2d(variance[None, None], SQUARE, stride=1)[0, 0]
    return divmod(int(means.argmax()), means.shape[1])


if __name__ == "__main__":
    main()
