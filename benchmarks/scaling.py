"""Measure how the cost of training and rendering grows, with a separate process for each row.

    python benchmarks/scaling.py [--steps 300] [--psnr 22] [AXIS=VALUE,VALUE ...]

AXIS is `pixels` (per side of an image), `views`, `bodies` (one inside the other) or `threads`; each varies while the
others keep their first value. Images of the embedded scene are scaled, and repeated for more than 100 views. Prints a
Markdown table of the rows and one of the slopes in logarithmic axes, and draws `docs/images/scaling.png`.

Times are processor times of all threads, except for the rows of `threads`, which show clock time.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any, cast

import lightning.pytorch as pl
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from training import SCENE, Training, write_images

import nerfro
from nerfro.core.types import Batch
from nerfro.evaluation.render_view import render_view
from nerfro.evaluation.validation import ValidationPixels
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.registry.registration import build
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.module import TrainingModule

AXES = {
    "pixels": [128, 64, 256, 512, 1024, 1600],
    "views": [100, 25, 50, 200, 400],
    "bodies": [1, 2, 4, 8],
    "threads": [1, 2],
}
COSTS = {
    "first step": "s to the first step",
    "step": "ms per step",
    "quality": "s to {psnr:g} dB",
    "render": "s per rendered megapixel",
    "memory": "peak MiB",
}
Costs = dict[str, float | None]
FIGURE = Path(__file__).resolve().parent.parent / "docs" / "images" / "scaling.png"
EVERY = 20  # steps between two measurements of the PSNR
STEPS = 40  # whose median time is reported
RENDERED = 128  # pixels per side of the view whose rendering is measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("axes", nargs="*", metavar="AXIS=VALUE,VALUE")
    parser.add_argument("--steps", type=int, default=300, help="most steps of the training that should reach --psnr")
    parser.add_argument("--psnr", type=float, default=22.0, help="that training has to reach on test views, dB")
    parser.add_argument("--figure", type=Path, default=FIGURE)
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train, for all rows")
    parser.add_argument("--measure", help=argparse.SUPPRESS)  # one row, in a process of its own
    arguments = parser.parse_args()
    if arguments.measure is not None:
        logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
        print(json.dumps(measure(**json.loads(arguments.measure))))
        return
    axes = {}
    for given in arguments.axes:
        name, values = given.split("=")
        axes[name] = [int(value) for value in values.split(",")]
    axes = axes or AXES
    base = {name: axes.get(name, values)[0] for name, values in AXES.items()}
    print(f"{os.cpu_count()} CPU cores, torch {torch.__version__}, {arguments.steps} steps, {date.today()}\n")
    heads = [head.format(psnr=arguments.psnr) for head in COSTS.values()]
    print(f"| row | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}")
    curves: dict[str, list[tuple[int, Costs]]] = {}
    measured: dict[tuple[object, ...], Costs] = {}  # the base row lies on several axes
    for name, values in axes.items():
        curves[name] = []
        for value in values:
            row, by_clock = base | {name: value}, name == "threads"
            key = (*row.values(), by_clock)
            if key not in measured:
                measured[key] = run_row(row, arguments.steps, arguments.psnr, arguments.options, by_clock)
            costs = measured[key]
            curves[name].append((value, costs))
            cells = ("not reached" if cost is None else f"{cost:.3g}" for cost in costs.values())
            print(f"| {value} {name} | {' | '.join(cells)} |", flush=True)
    print(f"\n| slope | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}")
    for name, curve in curves.items():
        print(f"| {name} | {' | '.join(slope(curve, cost) for cost in COSTS)} |")
    draw(curves, heads, arguments.figure)


def run_row(row: dict[str, int], steps: int, psnr: float, options: list[str], by_clock: bool) -> Costs:
    """Write the data of a row and measure it in a process of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_images(folder, row["pixels"], row["views"])
        overrides = [f"data.root={folder}", "data=blender", *write_bodies(folder, row["bodies"]), *options]
        task = {"overrides": overrides, "steps": steps, "psnr": psnr, "by_clock": by_clock, "begun": time.time()}
        threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(row["threads"]))
        with subprocess.Popen(
            [sys.executable, __file__, "--measure", json.dumps(task)],
            env=os.environ | threads,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            output = process.communicate()[0]
    if process.returncode != 0:
        raise SystemExit(f"failed: {row}")
    return json.loads(output.splitlines()[-1])


def write_bodies(folder: Path, count: int) -> list[str]:
    """Write nested copies of the embedded mesh, and return the options of the medium."""
    outer = load_mesh(SCENE / "mesh.ply")
    files = []
    for number in range(count):
        files.append(str(folder / f"body_{number}.ply"))
        TriangleMesh(outer.vertices * 0.9**number, outer.faces).save(Path(files[-1]))
    iors = [1.33 if number % 2 else 1.5 for number in range(count)]
    bodies = [f"body_{number}: {{mesh: {file}, ior: {iors[number]}}}" for number, file in enumerate(files)]
    return [f"medium.bodies={{{', '.join(bodies)}}}"]


class Quality(pl.Callback):
    """Stop when the PSNR of test pixels reaches a goal; it is measured every `EVERY` steps.

    Attributes:
        seconds: time until the goal without the measurements; None if the goal was not reached.
    """

    def __init__(self, pixels: ValidationPixels, goal: float, clock: Callable[[], float]) -> None:
        self.pixels, self.goal, self.clock, self.start = pixels, goal, clock, clock()
        self.seconds: float | None = None

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if (batch_idx + 1) % EVERY == 0:
            now = self.clock()
            with torch.no_grad():
                psnr = self.pixels.psnr(cast(TrainingModule, pl_module).renderer, Subdivision())
            if float(psnr) >= self.goal:
                self.seconds, trainer.should_stop = now - self.start, True
            self.start += self.clock() - now


def measure(overrides: list[str], steps: int, psnr: float, by_clock: bool, begun: float) -> Costs:
    """Measure the costs of steps, of rendering one view, and of a whole training with all phases."""
    clock = time.perf_counter if by_clock else time.process_time
    training = Training(*overrides)
    training.run(1)
    costs: Costs = {"first step": time.time() - begun if by_clock else time.process_time()}
    timed = training.run(STEPS)
    costs["step"] = 1e3 * float(np.median(timed.seconds if by_clock else timed.processor))
    test = build(training.config.data).load("test")
    del training, timed  # its pixels
    module, data = nerfro.build(overrides=[*overrides, "evaluation.every=0"])
    quality = Quality(ValidationPixels.of(test), psnr, clock)
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    pl.Trainer(max_steps=steps, callbacks=[quality], accelerator="cpu", **quiet).fit(module, datamodule=data)
    costs["quality"] = quality.seconds
    cameras = test.cameras.resized(RENDERED, RENDERED)
    render_view(module.renderer, cameras, 0, Subdivision())  # compiles
    start = clock()
    render_view(module.renderer, cameras, 0, Subdivision())
    costs["render"] = (clock() - start) * 1e6 / RENDERED**2
    costs["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return costs


def slope(curve: list[tuple[int, Costs]], cost: str) -> str:
    """Fit the exponent with which a cost grows."""
    points = [(value, costs[cost]) for value, costs in curve if costs[cost] is not None]
    if len(points) < 2:
        return "n/a"
    return f"{np.polyfit(*np.log(np.transpose(points)), 1)[0]:.2f}"


def draw(curves: dict[str, list[tuple[int, Costs]]], heads: list[str], file: Path) -> None:
    """Draw every measured cost against every axis, in logarithmic axes."""
    measured = {
        cost: head
        for cost, head in zip(COSTS, heads, strict=True)
        if any(costs[cost] is not None for curve in curves.values() for _, costs in curve)
    }
    figure = Figure(figsize=(3 * len(curves), 2.2 * len(measured)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(measured), len(curves), squeeze=False, sharex="col", sharey="row")
    for column, (name, curve) in enumerate(curves.items()):
        for row, (cost, head) in enumerate(measured.items()):
            points = sorted((value, costs[cost]) for value, costs in curve if costs[cost] is not None)
            axes = grid[row, column]
            axes.loglog([value for value, _ in points], [value for _, value in points], "o-")
            axes.set_xticks(sorted(value for value, _ in curve), minor=False)
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter("{x:g}")
                axis.set_minor_locator(NullLocator())
            axes.grid(alpha=0.3)
            if column == 0:
                axes.set_ylabel(head)
        grid[-1, column].set_xlabel("pixels per side" if name == "pixels" else name)
    figure.savefig(file, dpi=80)


if __name__ == "__main__":
    main()
