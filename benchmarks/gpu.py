"""Compare a GPU with the CPU: results, times of a step by part, quality over time, views, and memory.

    python benchmarks/gpu.py --out gpu.json

The command takes at most eight minutes (`--minutes`), because each part has a share of the time, and prints tables as
Markdown. Cells of missing devices, of parts without time, and of failed parts are "n/a"; the JSON file has the reasons.
The script needs the packages of nerfro's `pyproject.toml`. On a machine without network, install them from a folder of
wheels: `pip install --no-index --find-links WHEELS -e .`
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from omegaconf import OmegaConf
from torch import Tensor
from training import EMBEDDED, MESH

import nerfro
from nerfro.core.paths import CONF_DIR, PLUGINS_DIR
from nerfro.evaluation.render_view import render_view
from nerfro.kernels.available import find_gpu, gpu_name, keep_freed_memory
from nerfro.rendering import RayTracer, Renderer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.accelerator import one_step, time_of
from nerfro.training.data_module import can_prefetch
from nerfro.training.module import TrainingModule

TIMED = ("refractive", "glass", "glass_room", "straight", "paper_fast", "paper_refractive")
STEP = 100_000  # at which all losses have begun
# Shares of the time at whose end a part begins nothing more.
ENDS = {"results": 0.3, "steps": 0.6, "quality": 0.8, "views": 1.0}


class Report:
    """Results of all parts, with the reasons of missing ones.

    Args:
        minutes: limit of the whole command.
    """

    def __init__(self, minutes: float) -> None:
        self._begun, self._seconds = time.perf_counter(), 60 * minutes
        self.parts: dict[str, Any] = {}

    def left(self, part: str) -> float:
        """Return the seconds that are left for a part."""
        return self._begun + ENDS[part] * self._seconds - time.perf_counter()

    def measure(self, part: str, row: str, column: str, task: Callable[[], Any] | None) -> None:
        """Record the result of a task, or why there is none."""
        cells = self.parts.setdefault(part, {}).setdefault(row, {})
        if task is None:
            cells[column] = "n/a: no GPU"
        elif self.left(part) <= 0:
            cells[column] = "n/a: no time"
        else:
            try:
                cells[column] = task()
            except Exception as error:  # a defect of one experiment must not end the report
                cells[column] = f"n/a: {type(error).__name__}: {error}".partition("\n")[0]
        print(f"{part}: {row}, {column}: {cells[column]}", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--experiments", nargs="+", default=list(TIMED), help="whose steps are timed")
    parser.add_argument("--steps", type=int, default=20, help="largest number of timed steps")
    parser.add_argument("--goals", type=float, nargs="+", default=[27, 30], help="dB")
    parser.add_argument("--sides", type=int, nargs="+", default=[400, 800], help="pixels of the timed views")
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train, for all experiments")
    arguments = parser.parse_args()
    keep_freed_memory()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    gpu, cores = find_gpu(), torch.get_num_threads()
    report = Report(arguments.minutes)
    report.parts["machine"] = {
        "gpu": "n/a: no GPU" if gpu is None else gpu_name(gpu), "processor": platform.processor() or platform.machine(),
        "threads": cores, "torch": torch.__version__, "cuda": torch.version.cuda or torch.version.hip or "n/a",
        "load": os.getloadavg()[0],
    }  # fmt: skip
    compare_results(report, gpu, arguments.options)
    # The GPU comes first, so that slow steps on the CPU do not take its time.
    cpu = torch.device("cpu")
    devices = [("GPU", gpu, cores), (f"{cores} cores", cpu, cores), ("1 core", cpu, 1), ("GPU, compiled", gpu, cores)]
    for title, device, threads in devices if cores > 1 else [devices[0], *devices[2:]]:
        for name in arguments.experiments:
            values = device, threads, title.endswith("compiled"), arguments, report
            task = None if device is None else lambda: parts_of_step(name, *values)  # noqa: B023
            report.measure("steps", name, title, task)
    for title, device in (("GPU", gpu), ("CPU", torch.device("cpu"))):
        quality_and_views(report, title, device, arguments)
    report.parts["memory, GiB"] = {"process": {"peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}}
    report.parts["memory, GiB"]["GPU"] = {
        "peak": torch.cuda.max_memory_allocated() / 2**30 if gpu is not None and gpu.type == "cuda" else "n/a: no GPU"
    }
    arguments.out.write_text(json.dumps(report.parts, indent=2) + "\n")
    print_tables(report.parts)


def compare_results(report: Report, gpu: torch.device | None, options: Sequence[str]) -> None:
    """Compare a step of 256 pixels of every experiment with the CPU, in single precision."""
    for file in sorted([*CONF_DIR.glob("experiment/*.yaml"), *PLUGINS_DIR.glob("*/conf/experiment/*.yaml")]):
        if "ablation_" not in file.stem:
            task = None if gpu is None else lambda: differences(file.stem, gpu, options)  # noqa: B023
            report.measure("results", file.stem, "differences", task)
    rows = report.parts["results"]
    for cells in rows.values():
        if isinstance(values := cells.pop("differences"), dict):
            cells.update(values)
        else:
            cells.update(dict.fromkeys(("loss", "radiance", "cosine"), values))


def differences(experiment: str, gpu: torch.device, options: Sequence[str]) -> dict[str, float]:
    """Return the relative difference of the loss, the difference of radiance, and the cosine between the gradients."""
    results = []
    for device in (torch.device("cpu"), gpu):
        module, data = build(experiment, "data.downscale=4", "trainer.precision=32-true", *options)
        for network in module.scene.fields.modules():
            if hasattr(network, "precision"):
                network.precision = "float32"
        results.append(one_step(module.to(device), data, "32-true"))
    (loss, radiance, gradient), (loss_, radiance_, gradient_) = results
    return {
        "loss": abs(loss_ / loss - 1),
        "radiance": float((radiance_ - radiance).abs().amax(-1).quantile(0.98)),
        "cosine": float(torch.cosine_similarity(gradient, gradient_, dim=0)),
    }


def build(experiment: str, *options: str) -> tuple[TrainingModule, Any]:
    """Build an experiment on the embedded scene."""
    torch.manual_seed(0)
    paper = ("+scene=torus", "medium.resolution=256") if "paper" in experiment else ()
    scene = (EMBEDDED[1], MESH) if experiment != "straight" else (EMBEDDED[1],)
    return nerfro.build(experiment, [*paper, *scene, "evaluation.every=0", *options])


def parts_of_step(
    experiment: str,
    device: torch.device,
    threads: int,
    is_compiled: bool,
    arguments: argparse.Namespace,
    report: Report,
) -> dict[str, float]:
    """Return milliseconds of the parts of a step, and of a step with rays traced one step ahead if possible."""
    module, data = build(experiment, *arguments.options)
    module.to(device)
    if is_compiled:
        module.scene.compile_radiance("inductor")
    optimizer = module.make_optimizer()
    batches, tracer = data.batches.to(device, torch.float32), RayTracer(module.renderer, data.subdivision)
    of_parts, number = dict.fromkeys(("tracing", "forward", "backward", "Adam"), 0.0), 0
    torch.set_num_threads(threads)
    begun, limit = time.perf_counter(), report.left("steps") / 4
    try:
        for number in range(arguments.steps + 1):
            clock = [time_of(device)]
            batch = tracer.trace(batches.draw(STEP + number))
            clock.append(time_of(device))
            total = module.objective(module.renderer.render_batch(batch), batch, module.scene, STEP).total
            clock.append(time_of(device))
            total.backward()
            clock.append(time_of(device))
            optimizer.step()
            optimizer.zero_grad()
            clock.append(time_of(device))
            if number > 0:  # the first step compiles kernels and allocates memory
                for name, before, after in zip(of_parts, clock[:-1], clock[1:], strict=True):
                    of_parts[name] += after - before
            if number > 0 and time.perf_counter() - begun > min(limit, 10.0):
                break
    finally:
        torch.set_num_threads(report.parts["machine"]["threads"])
    ms = {name: 1e3 * seconds / max(number, 1) for name, seconds in of_parts.items()}
    rest = sum(ms.values()) - ms["tracing"]
    return ms | {"step": max(ms["tracing"], rest) if can_prefetch(module.renderer) else ms["tracing"] + rest}


class Quality(pl.Callback):
    """Measure PSNR of four test views while training, and stop at the last goal.

    Args:
        goals: values of PSNR, dB.
        subdivision: which pixels get several rays.

    Attributes:
        reached: seconds of training until each goal, without the measurements.
        psnr: last measurement, dB.
    """

    def __init__(self, goals: Sequence[float], subdivision: Subdivision) -> None:
        self.reached: dict[float, float] = {}
        self.psnr, self._goals, self._subdivision = 0.0, goals, subdivision
        self._next, self._outside, self._begun = 2.0, 0.0, 0.0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._begun = time.perf_counter()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, *_: Any) -> None:
        if time.perf_counter() - self._begun - self._outside < self._next:
            return
        before = time_of(pl_module.device)
        elapsed = before - self._begun - self._outside
        self.psnr = psnr_of(pl_module.renderer, trainer.datamodule.test, self._subdivision)  # type: ignore[attr-defined]
        for goal in self._goals:
            if self.psnr >= goal:
                self.reached.setdefault(goal, elapsed)
        self._next, self._outside = 1.15 * elapsed, self._outside + time.perf_counter() - before
        trainer.should_stop = len(self.reached) == len(self._goals)


@torch.no_grad()
def psnr_of(renderer: Renderer, views: Any, subdivision: Subdivision) -> float:
    """Return the PSNR of four test views."""
    device = next(renderer.parameters()).device
    cameras, errors = views.cameras.to(device), list[Tensor]()
    for view in range(0, len(views), max(1, len(views) // 4)):
        image = renderer.scene.colour_space.to_display(render_view(renderer, cameras, view, subdivision).radiance)
        errors.append((image - views.images[view].to(device).reshape(image.shape)).square().mean())
    return -10 * math.log10(float(torch.stack(errors).mean()))


def quality_and_views(report: Report, title: str, device: torch.device | None, arguments: argparse.Namespace) -> None:
    """Train the default configuration to the goals of PSNR, and time views of the trained model."""
    module, data = build("refractive", *arguments.options)
    checkpoint: dict[str, Any] = {}
    module.on_save_checkpoint(checkpoint)
    subdivision = Subdivision(**OmegaConf.create(checkpoint["nerfro_config"]).evaluation.subdivision)
    quality = Quality(arguments.goals, subdivision)
    seconds_left = max(report.left("quality") / (2 if title == "GPU" else 1), 1.0)

    def train() -> float:
        pl.Trainer(
            max_time={"seconds": seconds_left}, accelerator="cpu" if title == "CPU" else "gpu", devices=1,
            callbacks=[quality], logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, limit_val_batches=0, num_sanity_val_steps=0, use_distributed_sampler=False,
        ).fit(module, datamodule=data)  # fmt: skip
        return psnr_of(module.renderer.to(device), data.test, subdivision)

    report.measure("quality", "PSNR at the end, dB", title, None if device is None else train)
    for goal in arguments.goals:
        reached = quality.reached.get(goal, "n/a: no GPU" if device is None else "n/a: no time")
        report.parts["quality"].setdefault(f"seconds to {goal:g} dB", {})[title] = reached

    def seconds(side: int, sampling: Subdivision) -> float:
        renderer = module.renderer.to(device)
        cameras = data.test.cameras.resized(side, side).to(device)
        render_view(renderer, data.test.cameras.resized(32, 32).to(device), 0, sampling)  # compiles kernels
        before = time_of(device)  # type: ignore[arg-type]
        render_view(renderer, cameras, 0, sampling)
        return time_of(device) - before  # type: ignore[arg-type]

    for side in arguments.sides:
        for kind, sampling in (("one ray a pixel", Subdivision()), ("supersampled", subdivision)):
            task = None if device is None else lambda: seconds(side, sampling)  # noqa: B023
            report.measure("views", f"{side}x{side}, {kind}, s", title, task)


def print_tables(parts: dict[str, Any]) -> None:
    """Print each part as a table."""
    print("\n" + ", ".join(f"{name} {shown(value)}" for name, value in parts["machine"].items()))
    for part, rows in parts.items():
        if part == "machine":
            continue
        if part == "steps":  # each device has a row with the parts of a step
            rows = {
                f"{row}, {column}": cell if isinstance(cell, dict) else {"step": cell}
                for row, cells in rows.items()
                for column, cell in cells.items()
            }
        columns = list(dict.fromkeys(column for cells in rows.values() for column in cells))
        print(f"\n| {part} | {' | '.join(columns)} |\n|---|" + "---|" * len(columns))
        for row, cells in rows.items():
            print(f"| {row} | {' | '.join(shown(cells.get(column, '')) for column in columns)} |")


def shown(value: object) -> str:
    """Format a cell; the reason of a missing one is in the JSON file."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return "n/a" if str(value).startswith("n/a") else str(value)


if __name__ == "__main__":
    main()
