"""Measure the speed of training and rendering, and the scores after a limited time. Each part prints Markdown.

    python benchmarks/training.py step                        # a step of the paper's recipe, plain and fast
    python benchmarks/training.py curve                       # their losses over 200 steps
    python benchmarks/training.py profile refractive          # parts of a step beside the bounds of the machine
    python benchmarks/training.py paths                       # share of live tracing in a step; see docs for one core
    python benchmarks/training.py branches                    # cost of a step with light that splits
    python benchmarks/training.py budget 00:00:05:00          # default preset and paper's recipe after the same time
    python benchmarks/training.py view RUN/checkpoints/last.ckpt   # rendering a 400x400 view

The parts use the embedded scene, and all cores unless OMP_NUM_THREADS and NUMBA_NUM_THREADS are set.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from datetime import date
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from omegaconf import OmegaConf
from PIL import Image
from torch.profiler import ProfilerActivity, profile, record_function

import nerfro
from nerfro.core.paths import ASSETS_DIR
from nerfro.core.rays import Rays
from nerfro.core.types import Batch
from nerfro.evaluation.render_view import render_view
from nerfro.evaluation.results import read_metrics_json
from nerfro.fields.hash_grid import HashGridField
from nerfro.kernels.available import fast_bfloat16, keep_freed_memory
from nerfro.rendering import RayTracer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.data_module import RayDataModule
from nerfro.training.trainer import lightning_precision

ROOT = Path(__file__).resolve().parent.parent
SCENE = ASSETS_DIR / "torus"
EMBEDDED = ("+scene=torus", f"data.root={SCENE}", "data.downscale=1")
MESH = f"medium.mesh={SCENE / 'mesh.ply'}"
PLAIN, FAST = "paper_refractive", "paper_fast"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    trained = {name: parts.add_parser(name) for name in ("step", "curve", "profile", "paths", "branches", "budget")}
    for name, default in (("step", 3), ("paths", 6), ("branches", 3)):
        trained[name].add_argument("--turns", type=int, default=default)
    trained["curve"].add_argument("--rays", type=int, default=64)
    for name, default in (("curve", 200), ("profile", 20), ("paths", 11), ("branches", 9)):
        trained[name].add_argument("--steps", type=int, default=default)
    trained["profile"].add_argument("experiment")
    trained["profile"].add_argument("--pixels", type=int, nargs="+", default=[128, 400, 800])
    trained["budget"].add_argument("budget", metavar="time")
    trained["budget"].add_argument("--out", type=Path, default=ROOT / "outputs" / "training_benchmark")
    for part in trained.values():
        part.add_argument("--options", nargs="+", default=[], help="of nerfro.train, for all trainings")
    view = parts.add_parser("view")
    view.add_argument("checkpoint", type=Path)
    view.add_argument("--side", type=int, default=400, help="pixels")
    view.add_argument("--turns", type=int, default=5)
    arguments = parser.parse_args()
    keep_freed_memory()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    print(f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}, {date.today()}", end="")
    print(f", load average {os.getloadavg()[0]:.1f}\n")
    reports: dict[str, Callable[..., None]] = {
        "step": report_step,
        "curve": report_curve,
        "profile": report_profile,
        "paths": report_paths,
        "branches": report_branches,
        "budget": report_budget,
        "view": report_view,
    }
    settings = vars(arguments)
    reports[settings.pop("part")](**settings)


class Steps(pl.Callback):
    """Record wall-clock time, processor time and loss of each training step.

    A step begins at the end of the previous step, so that its time includes its batch and the phases that precede it.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.processor: list[float] = []
        self.losses: list[float] = []

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._last, self._last_processor = time.perf_counter(), time.process_time()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        now, processor = time.perf_counter(), time.process_time()
        self.seconds.append(now - self._last)
        self.processor.append(processor - self._last_processor)
        self._last, self._last_processor = now, processor
        self.losses.append(float(outputs["loss"]))


class Training:
    """An experiment that can be trained for a few steps at a time, with all its phases.

    The steps of phases before the training are taken once, in the first run.

    Args:
        overrides: Hydra overrides of conf/train.yaml.
    """

    def __init__(self, *overrides: str) -> None:
        self.module, self.data = nerfro.build(overrides=[*overrides, "evaluation.every=0"])
        checkpoint: dict[str, str] = {}
        self.module.on_save_checkpoint(checkpoint)
        self.config = OmegaConf.create(checkpoint["nerfro_config"])
        self.renderer, self.batches = self.module.renderer, self.data.batches
        self.num_rays = self.batches.batch_size

    def batch(self, step: int) -> Batch:
        """Trace the batch of a step."""
        return RayTracer(self.renderer, self.data.subdivision).trace(self.batches.draw(step))

    def run(self, num_steps: int, data: RayDataModule | None = None, callbacks: Sequence[pl.Callback] = ()) -> Steps:
        """Train for some steps with a new optimizer; the time of callbacks after a step counts for the next step."""
        steps = Steps()
        trainer = pl.Trainer(
            max_steps=num_steps,
            accelerator="cpu",
            callbacks=[steps, *callbacks],
            precision=lightning_precision(self.config),
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
        )
        trainer.fit(self.module, datamodule=data or self.data)
        return steps


def paper_recipe(experiment: str, *overrides: str) -> Training:
    """Return the paper's recipe on the embedded scene, with an index grid of 256 instead of 512 vertices per side."""
    return Training(*EMBEDDED, f"+experiment={experiment}", MESH, "medium.resolution=256", *overrides)


def report_step(turns: int, options: list[str]) -> None:
    """Measure a step of 1024 rays in single precision with every sample evaluated, and faster settings."""
    variants = {
        "plain: float32, every sample evaluated (`paper_refractive`)": paper_recipe(PLAIN, *options),
        "bfloat16 products (`trainer.precision=bf16-mixed`)": paper_recipe(
            PLAIN, "trainer.precision=bf16-mixed", *options
        ),
        "bfloat16, only samples in the object's bounds (`paper_fast`)": paper_recipe(FAST, *options),
    }
    fastest = dict.fromkeys(variants, float("inf"))
    for _ in range(turns):
        for name, training in variants.items():
            fastest[name] = min(fastest[name], *training.run(3).seconds[1:])  # the first one allocates
    plain, *_ = fastest.values()
    print("| step of the paper's recipe, 1024 rays | ms | speed-up |\n|---|---|---|")
    for name, seconds in fastest.items():
        print(f"| {name} | {1e3 * seconds:.0f} | {plain / seconds:.1f}x |")


def report_curve(steps: int, rays: int, options: list[str]) -> None:
    """Compare total losses of plain and fast training from the same weights and pixels, and from other pixels."""
    # With warm-up, the first 200 steps would learn nothing.
    rate = (*options, "optimizer.warmup_steps=0", f"batches.size={rays}")
    bf16 = "trainer.precision=bf16-mixed"
    runs = {
        "plain": paper_recipe(PLAIN, *rate),
        "bfloat16 products": paper_recipe(PLAIN, *rate, bf16),
        "`paper_fast`": paper_recipe(FAST, *rate),
        "plain, another seed": paper_recipe(PLAIN, *rate, "seed=1"),
    }
    losses = {name: np.array(training.run(steps).losses) for name, training in runs.items()}
    print(f"Total loss, {rays} rays a step, mean of 50 steps:\n")
    windows = range(0, steps, 50)
    print(f"| run | {' | '.join(f'{w + 1} to {w + 50}' for w in windows)} | mean difference from plain, step by step |")
    print("|---|" + "---|" * (len(windows) + 1))
    for name, loss in losses.items():
        means = " | ".join(f"{loss[w : w + 50].mean():.4f}" for w in windows)
        print(f"| {name} | {means} | {np.abs(loss - losses['plain']).mean():.4f} |")


def report_profile(experiment: str, pixels: list[int], steps: int, options: list[str]) -> None:
    """Print the processor time of the parts of a step beside the bounds that the machine sets.

    Args:
        experiment: name of the experiment.
        pixels: sides of the images, to which the images of the embedded scene are scaled.
        steps: number of measured steps.
        options: further options of nerfro.train.
    """
    limits = Limits()
    columns = []
    for side in pixels:
        with tempfile.TemporaryDirectory() as folder:
            write_images(Path(folder), side, 100)
            settings = [f"data.root={folder}", "data=blender", MESH, *options]
            paper = experiment.startswith("paper")
            training = (
                paper_recipe(experiment, *settings) if paper else Training(f"+experiment={experiment}", *settings)
            )
            columns.append(parts_of_step(training, steps, limits))
    print(f"| part of a step, `{experiment}` | {' | '.join(f'{side} pixels, ms | bound | ratio' for side in pixels)} |")
    print("|---|" + "---|" * 3 * len(pixels))
    for name in columns[0]:
        cells = (
            f"{ms:.1f} | {f'{bound:.1f} | {ms / bound:.1f}' if bound else ' | '}"
            for ms, bound in (column[name] for column in columns)
        )
        print(f"| {name} | {' | '.join(cells)} |")
    print(f"\n| bound | measured |\n|---|---|\n{limits}")


class Limits:
    """Rates of the machine, each the best of ten measurements.

    Attributes:
        products: operations per second of a product of 4096x64 and 64x64, by number format.
        bytes: bytes per second of a sum of arrays of 16 MB.
        read: seconds of a random read of 8 bytes from 16 MB.
        operator: seconds of an operator of PyTorch on one number.
    """

    def __init__(self) -> None:
        self.products = {dtype: matrix_rate(dtype, 4096, 64) for dtype in (torch.float32, torch.bfloat16)}
        values, result = torch.rand(2, 2**22), torch.rand(2**22)
        self.bytes = 3 * result.nbytes / fastest(lambda: torch.add(*values, out=result))
        table, rows = torch.rand(2**21, dtype=torch.float64), torch.randint(2**21, (2**20,))
        self.read = fastest(lambda: table.index_select(0, rows)) / len(rows)
        one = torch.ones(1)
        self.operator = fastest(lambda: [torch.add(one, one, out=one) for _ in range(1000)]) / 1000

    def __str__(self) -> str:
        single, half = (rate / 1e12 for rate in self.products.values())
        return (
            f"| product of 4096x64 and 64x64, float32; bfloat16 | {single:.2f}; {half:.2f} TFLOP/s |\n"
            f"| sum of arrays of 16 MB | {self.bytes / 1e9:.0f} GB/s |\n"
            f"| random read from 16 MB | {1e9 * self.read:.1f} ns |\n"
            f"| operator of PyTorch on one number | {1e6 * self.operator:.1f} µs |"
        )


def parts_of_step(training: Training, steps: int, limits: Limits) -> dict[str, tuple[float, float]]:
    """Return milliseconds of the parts of a step and the bound of each; 0 for no bound.

    Rays are traced in the training thread, because the profiler measures only this thread.
    """
    model = training.renderer
    data = TracedInStep(training.batches, subdivision=training.data.subdivision)
    training.run(3, data)
    whole = float(np.median(training.run(steps + 1, data).processor[1:]))
    with ExitStack() as stack:
        label(stack, RayTracer, "through", "tracing")
        label(stack, model.point_sampler, "choose_ahead", "samples")
        label(stack, model.point_sampler, "forward", "samples")
        with profile(activities=[ProfilerActivity.CPU], record_shapes=True, with_flops=True) as measured:
            training.run(steps, data)
    events = measured.key_averages(group_by_input_shape=True)

    def seconds(*names: str) -> float:
        return sum(event.cpu_time_total for event in events if event.key in names) / 1e6 / steps

    def of_kernel(name: str) -> list[Any]:
        kernels = f"nerfro::{name}_forward", f"nerfro::{name}_gradient"
        return [event for event in events if event.key.startswith(kernels)]

    def seconds_of_kernel(name: str) -> float:
        return sum(event.cpu_time_total for event in of_kernel(name)) / 1e6 / steps

    def reads(name: str, for_each: int) -> float:
        """Return the number of reads of a kernel and its gradients, given the number for each point."""
        return for_each * sum(event.count * max(event.input_shapes[0]) for event in of_kernel(name)) / steps

    products = ("aten::mm", "aten::addmm", "aten::bmm", "mkldnn::_linear_pointwise")
    (field, *_), sky = model.scene.fields, model.scene.background
    hashed, sky_levels = (len(part.levels.resolutions) if hasattr(part, "levels") else 0 for part in (field, sky))
    rounds = isinstance(field, HashGridField) and fast_bfloat16("cpu")
    rounds = rounds or training.config.trainer.precision != "32-true"
    num_parameters = sum(own.numel() for own in training.module.parameters())
    rate = limits.products[torch.bfloat16 if rounds else torch.float32]
    batch = training.batch(0)
    parts = {
        "tracing": (seconds("tracing"), len(batch.rays) * seconds_per_ray(training, batch.rays)),
        "matrix products": (seconds(*products), sum(event.flops for event in events) / steps / rate),
        "hash encoding": (seconds_of_kernel("hash_encode"), limits.read * reads("hash_encode", 8 * hashed)),
        "samples": (seconds("samples"), limits.read * getattr(model.point_sampler, "num_bins", 0) * len(batch.path.s)),
        "background": (seconds_of_kernel("cube_lookup"), limits.read * reads("cube_lookup", 4 * sky_levels)),
        "Adam": (seconds("aten::_fused_adam_"), 28 * num_parameters / limits.bytes),
    }
    rest = whole - sum(busy for busy, _ in parts.values())
    small = sum(event.count for event in events if event.key.startswith("aten::")) / steps
    parts |= {"other operators and Python": (rest, small * limits.operator)}
    parts |= {"whole step": (whole, sum(bound for _, bound in parts.values()))}
    return {name: (1e3 * busy, 1e3 * bound) for name, (busy, bound) in parts.items()}


def seconds_per_ray(training: Training, rays: Rays) -> float:
    """Return the time of a ray if the rays of sixteen batches are traced in one call."""
    many = rays[torch.arange(len(rays)).repeat(16)]
    model = training.renderer
    return fastest(lambda: model.path_sampler(many, model.scene.medium), turns=3) / len(many)


def write_images(folder: Path, pixels: int, views: int) -> None:
    """Write images of the embedded scene, scaled and repeated."""
    for split, count in (("train", views), ("test", 5)):
        document = json.loads((SCENE / f"transforms_{split}.json").read_text())
        frames = []
        for number in range(count):
            frame = document["frames"][number % len(document["frames"])]
            file = folder / f"{split}_{number:03d}.png"
            given = Image.open(SCENE / f"{frame['file_path']}.png").convert("RGB")
            given.resize((pixels, pixels), Image.Resampling.BICUBIC).save(file, compress_level=1)
            frames.append({"file_path": file.stem, "transform_matrix": frame["transform_matrix"]})
        (folder / f"transforms_{split}.json").write_text(json.dumps(document | {"frames": frames}))


class TracedInStep(RayDataModule):
    """Trace the paths of a batch within its step, as for a medium with learned parameters."""

    def train_dataloader(self) -> Iterator[int]:
        steps = super().train_dataloader()
        self.end_thread()
        return steps


class ReadyBatches(TracedInStep):
    """Repeat the batches of the first steps, traced before training starts."""

    def __init__(self, training: Training, num_steps: int) -> None:
        super().__init__(training.batches, subdivision=training.data.subdivision)
        with torch.no_grad():
            self.ready = [training.batch(step) for step in range(num_steps)]

    def transfer_batch_to_device(self, batch: int, device: torch.device, dataloader_idx: int) -> Batch:
        return self.ready[batch]


def report_paths(turns: int, steps: int, options: list[str]) -> None:
    """Measure the share of live tracing in a step of the default preset, against the same batches made before.

    The methods alternate, and the median of the turns of each method counts. Processor time is of all threads.
    """
    training = Training("+experiment=refractive", *options)
    batches, subdivision = training.batches, training.data.subdivision
    ready = ReadyBatches(training, steps)
    methods: dict[str, Callable[[], RayDataModule]] = {
        "ready before training": lambda: ready,
        "one step ahead (as trained)": lambda: RayDataModule(batches, subdivision=subdivision),
        "in the step": lambda: TracedInStep(batches, subdivision=subdivision),
    }
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for turn in range(turns + 1):
        for name, make in methods.items():
            begun = time.process_time()
            walls = training.run(steps, make()).seconds[1:]
            if turn > 0:  # the first one compiles and allocates
                seconds[name].append((float(np.median(walls)), (time.process_time() - begun) / steps))
    base = np.median([wall for wall, _ in seconds["ready before training"]])
    cores = len(os.sched_getaffinity(0))
    print(f"| default preset, {cores} cores: paths | ms a step | cost | processor, ms a step |\n|---|---|---|---|")
    for name, measured in seconds.items():
        wall, processor = np.median(measured, 0)
        print(f"| {name} | {1e3 * wall:.1f} | {wall / base - 1:+.1%} | {1e3 * processor:.1f} |")


def report_branches(turns: int, steps: int, options: list[str]) -> None:
    """Measure a step of the default preset with and without light that splits, and with a learned tint, in turns.

    Processor time is of all threads, and hardly depends on other programs.
    """
    of_path = "sampler.path.branches"
    variants = {
        "none (`refractive`)": Training("+experiment=refractive", *options),
        "first": Training("+experiment=refractive", f"{of_path}=first", *options),
        "all": Training("+experiment=refractive", f"{of_path}=all", *options),
        "all, and the tint learns (`glass`)": Training("+experiment=glass", *options),
    }
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in variants}
    for turn in range(turns + 1):
        for name, training in variants.items():
            measured = training.run(steps)
            if turn > 0:  # the first one compiles and allocates
                seconds[name].append((float(np.median(measured.seconds[1:])), float(np.median(measured.processor[1:]))))
    base = np.median(seconds["none (`refractive`)"], 0)
    print("| default preset, branches | paths a training ray | ms a step | processor, ms | against one path |")
    print("|---|---|---|---|---|")
    for name, training in variants.items():
        path = training.batch(0).path
        assert path is not None
        wall, processor = np.median(seconds[name], 0)
        paths = len(path.ray) / path.num_rays
        print(f"| {name} | {paths:.2f} | {1e3 * wall:.1f} | {1e3 * processor:.1f} | {processor / base[1]:.2f}x |")


def label(stack: ExitStack, owner: object, method: str, name: str) -> None:
    """Count the calls of a method under a name in a profile, until the stack unwinds."""
    wrap(stack, owner, method, lambda: record_function(name))


def clock(stack: ExitStack, owner: object, method: str, name: str, seconds: dict[str, float]) -> None:
    """Add the processor time of a method's calls to `seconds`, until the stack unwinds."""

    @contextmanager
    def clocked() -> Iterator[None]:
        start = time.process_time()
        yield
        seconds[name] += time.process_time() - start

    wrap(stack, owner, method, clocked)


def wrap(stack: ExitStack, owner: object, method: str, context: Callable[[], AbstractContextManager]) -> None:
    """Run the calls of a method in a context, until the stack unwinds."""
    original = getattr(owner, method)

    def wrapped(*args: object, **kwargs: object) -> object:
        with context():
            return original(*args, **kwargs)

    shadowed = method in vars(owner)
    setattr(owner, method, wrapped)
    stack.callback(lambda: setattr(owner, method, original) if shadowed else delattr(owner, method))


def matrix_rate(dtype: torch.dtype, rows: int, width: int) -> float:
    """Return the operations per second of a product with a square matrix."""
    left, right = torch.randn(rows, width).to(dtype), torch.randn(width, width).to(dtype)
    return 2 * rows * width**2 / fastest(lambda: left @ right)


def fastest(task: Callable[[], object], turns: int = 10) -> float:
    """Return the processor time of the fastest of several calls."""
    return min(spent(task)[1] for _ in range(turns))


def timed(task: Callable[[], object]) -> float:
    """Return the seconds of one call."""
    start = time.perf_counter()
    task()
    return time.perf_counter() - start


def report_budget(budget: str, out: Path, options: list[str]) -> None:
    """Compare test scores of the default preset and the paper's recipe after the same time on the embedded scene.

    The recipe has its fast settings, which allow several times as many steps as the plain settings.
    """
    commands = {"refractive": [], FAST: [*EMBEDDED, MESH, "medium.resolution=256"]}
    print(
        f"| experiment | steps in {budget} | rays/s | PSNR, 20 test views | SSIM |\n|---|---|---|---|---|", flush=True
    )
    for name, overrides in commands.items():
        folder = out / f"{name}_{budget.replace(':', '')}"
        if not (folder / "metrics.json").exists():
            command = [sys.executable, "-m", "nerfro.train", *overrides, f"+experiment={name}"]
            command += [f"hydra.run.dir={folder.resolve()}"]
            command += [f"trainer.max_time={budget}", "trainer.max_steps=-1", "evaluation.every=0", *options]
            folder.mkdir(parents=True, exist_ok=True)
            with (folder / "output.log").open("w") as log:
                subprocess.run(command, check=True, cwd=ROOT, stdout=log, stderr=log)
        run = read_metrics_json(folder / "metrics.json")
        means = run.result.means()
        print(
            f"| `{name}` | {run.steps} | {run.rays_per_second:.0f} | {means['psnr']:.2f} | {means['ssim']:.3f} |",
            flush=True,
        )


def report_view(checkpoint: Path, side: int, turns: int) -> None:
    """Measure rendering of a test view with one ray per pixel, also by component, and with supersampling as in the run.

    Processor time hardly depends on other programs; the fastest of the turns counts.
    """
    scene = nerfro.load(checkpoint)
    cameras, model = scene.cameras("test").resized(side, side), scene.renderer
    print(f"| {side}x{side} view of `{scene.name}` | s | processor, s |\n|---|---|---|")
    for name, sampling in (("one ray a pixel", Subdivision()), ("supersampled", scene.subdivision)):
        measured = [spent(lambda: render_view(model, cameras, 0, sampling)) for _ in range(turns)]  # noqa: B023
        print(f"| {name} | {min(wall for wall, _ in measured):.2f} | {min(busy for _, busy in measured):.2f} |")
    parts: dict[str, list[tuple[object, str]]] = {
        "tracing": [(model.path_sampler, "forward")],
        "which rays may meet anything": [(model, "_may_meet")],
        "choosing samples": [(model.point_sampler, "forward")],
        "field": [(field, "forward") for field in model.scene.fields],
        "sky": [(model.scene.background, "forward")],
    }
    fastest, of_parts = float("inf"), dict.fromkeys(parts, 0.0)
    for _ in range(turns):
        seconds = dict.fromkeys(parts, 0.0)
        with ExitStack() as stack:
            for name, methods in parts.items():
                for owner, method in methods:
                    clock(stack, owner, method, name, seconds)
            busy = spent(lambda: render_view(model, cameras, 0, Subdivision()))[1]
        if busy < fastest:
            fastest, of_parts = busy, seconds
    print("\n| one ray a pixel | processor, s |\n|---|---|")
    for name, value in (of_parts | {"the rest": fastest - sum(of_parts.values())}).items():
        print(f"| {name} | {value:.2f} |")


def spent(task: Callable[[], object]) -> tuple[float, float]:
    """Return the wall-clock time and the processor time of one call, in seconds."""
    busy = time.process_time()
    return timed(task), time.process_time() - busy


if __name__ == "__main__":
    main()
