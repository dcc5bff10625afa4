"""Peak memory of training and of evaluating one view with the default preset, each in a process of its own.

    python benchmarks/memory.py [--side 400] [--steps 30]

Prints a Markdown table of peak resident memory, libraries and data included; load on the machine does not change it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path

import torch

from nerfro.evaluation.render_view import Supersampling, render_view
from nerfro.registry import build, discover
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint, restore

BATCH_SIZES = (1024, 2048, 8192)
CHUNK_SIZES = (1024, 4096, 16384)
# A run evaluates its test views in the end; so that this is not its peak.
_TRAINING = ("trainer.max_time=null", "evaluation.every=0", "evaluation.chunk_size=256", "evaluation.supersample=1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--side", type=int, default=400, help="pixels along each side of the view")
    parser.add_argument("--steps", type=int, default=30, help="of training")
    parser.add_argument("--render", nargs=2, metavar=("CHECKPOINT", "CHUNK"), help="only render; 0 rays: only load")
    arguments = parser.parse_args()
    if arguments.render is not None:
        render(Path(arguments.render[0]), int(arguments.render[1]), arguments.side)
        return
    print(f"{os.cpu_count()} CPU cores, torch {torch.__version__}, {date.today()}\n")
    print("| task | rays at once | peak, MiB |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for size in BATCH_SIZES:
            options = [*_TRAINING, f"trainer.max_steps={arguments.steps}", f"batches.size={size}"]
            run = Path(folder, str(size))
            print(f"| {arguments.steps} steps of training | {size} | ", end="", flush=True)
            print(f"{peak([sys.executable, '-m', 'nerfro.train', *options, f'hydra.run.dir={run}']):.0f} |", flush=True)
        for size in (0, *CHUNK_SIZES):
            task = "nothing rendered" if size == 0 else f"a {arguments.side}x{arguments.side} view"
            print(f"| {task} | {size or ''} | ", end="", flush=True)
            command = [sys.executable, __file__, "--side", str(arguments.side), "--render"]
            print(f"{peak([*command, str(run / LAST_CHECKPOINT), str(size)]):.0f} |", flush=True)


def peak(command: list[str]) -> float:
    """Peak resident memory of a command, MiB."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"failed: {' '.join(command)}")
    return usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def render(checkpoint: Path, chunk_size: int, side: int) -> None:
    """Render the first test view at another resolution, supersampled as the preset does."""
    discover()
    trained, config = load_checkpoint(checkpoint)
    config.evaluation.chunk_size = max(chunk_size, 1)
    cameras = build(config.data).load("test").cameras
    model = restore(trained, config)
    if chunk_size > 0:
        # The preset's own supersampling, which the run was told to leave out.
        render_view(model, cameras.resized(side, side), 0, Supersampling(3, config.evaluation.divergence))


if __name__ == "__main__":
    main()
