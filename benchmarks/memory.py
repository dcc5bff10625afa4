"""Measure the memory of training and evaluation with the default preset, with a separate process for each row.

    python benchmarks/memory.py [--steps 300] [ROW ...]

Writes folders of noise images, trains on them, evaluates one view, and prints a Markdown table, and another one with
the largest memory of each part of a run. ROW is `embedded` or COUNTxWIDTHxHEIGHT of the training images. Load on the
machine changes the times but not the memory. The memory of the process leaves out mapped files, such as photographs,
whose pages the system can drop at any time.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from datetime import date
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerfro.core.paths import cache_dir

# The embedded scene, and numbers of training pictures with their width and height.
ROWS = ("embedded", "60x400x400", "200x800x800", "300x1600x1200")
_FIRST_STEP = re.compile(r"step [1-9]")
_PROGRESS = re.compile(r"(\w+): +\d+%")
# Parts of a run by their bars of progress; the bar of the training appears before the fits of the background.
PARTS = {
    "start": "before training",
    "background": "fits of the background",
    "train": "training",
    "evaluate": "evaluation",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"default: {', '.join(ROWS)}")
    parser.add_argument("--steps", type=int, default=300, help="of training")
    parser.add_argument("--options", nargs="+", default=[], help="of nerfro.train, for all rows")
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} CPU cores, torch {torch.__version__}, {arguments.steps} steps, {date.today()}\n")
    print("| training images | seconds to the first step | MiB after the first step", end=" | ")
    print("after one minute | at the last step | peak | peak with mapped files |")
    print("|---|---|---|---|---|---|---|")
    parts: list[str] = []
    for name in arguments.rows or ROWS:
        count, width, height = (0, 128, 128) if name == "embedded" else map(int, name.split("x"))
        with tempfile.TemporaryDirectory() as folder:
            options = [f"trainer.max_steps={arguments.steps}", f"hydra.run.dir={folder}/run"]
            if count > 0:
                make_noise(Path(folder), count, width, height)
                options += [f"data.root={folder}", "medium.mesh=embedded:torus/mesh.ply"]
            kept = set(cache_dir().glob("mapped_*.npy"))
            measured, largest = measure(["trainer.max_time=null", "evaluation.every=0", *options, *arguments.options])
            for path in set(cache_dir().glob("mapped_*.npy")) - kept:
                path.unlink()
        row = f"| {count or 100} of {width}x{height} | "
        print(row + " | ".join(measured) + " |", flush=True)
        parts.append(row + " | ".join(f"{largest[part]:.0f}" if part in largest else "n/a" for part in PARTS) + " |")
    print(f"\n| largest MiB | {' | '.join(PARTS.values())} |\n|---|{'---|' * len(PARTS)}")
    print("\n".join(parts))


def make_noise(folder: Path, count: int, width: int, height: int) -> None:
    """Write noise images with cameras on a circle around the origin; the last image is the test view."""
    generator = np.random.default_rng(0)
    frames = []
    for number in range(count + 1):
        levels = generator.integers(0, 256, (height, width, 3), dtype=np.uint8)
        Image.fromarray(levels).save(folder / f"{number}.png", compress_level=1)
        turn = 2 * math.pi * number / count
        cos, sin = math.cos(turn), math.sin(turn)
        pose = [[-sin, 0, cos, 4 * cos], [cos, 0, sin, 4 * sin], [0, 1, 0, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose})
    for split, chosen in (("train", frames[:count]), ("test", frames[count:])):
        document = {"camera_angle_x": 0.69, "frames": chosen}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))


def measure(options: list[str]) -> tuple[list[str], dict[str, float]]:
    """Measure the seconds to the first step and the memory in MiB.

    Returns:
        Seconds; memory without mapped files after the first step, a minute later, at the last step and at its peak;
        peak with mapped files. Largest memory without mapped files in each of `PARTS`.
    """
    begun = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "nerfro.train", *options], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    samples: list[tuple[float, float]] = []  # seconds, MiB

    def watch() -> None:
        for megabytes in _own_memory(process.pid):
            samples.append((time.perf_counter() - begun, megabytes))
            time.sleep(0.5)

    threading.Thread(target=watch, daemon=True).start()
    assert process.stderr is not None
    first, last, shown = math.inf, 0.0, ""
    largest: dict[str, float] = {}
    seen = 0  # samples that belong to a part
    while part := os.read(process.stderr.fileno(), 4096).decode(errors="replace"):
        shown = (shown + part)[-8192:]
        now = time.perf_counter() - begun
        if first == math.inf and _FIRST_STEP.search(part):
            first = now
        if "evaluate" not in shown:
            last = now
        for name in _PROGRESS.findall(part)[-1:]:  # a bar also appears at the end of its part
            of_part = name if largest else "start"
            new = [largest.get(of_part, 0.0), *(megabytes for _, megabytes in samples[seen:])]
            largest[of_part], seen = max(new), seen + len(new) - 1
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"failed: {' '.join(options)}\n{shown}")
    at = [next((m for t, m in reversed(samples) if t <= when), math.nan) for when in (first + 1, first + 60, last)]
    memory = [*at, max(megabytes for _, megabytes in samples), usage.ru_maxrss / 1024]
    return [f"{first:.0f}", *(f"{megabytes:.0f}" for megabytes in memory)], largest


def _own_memory(pid: int) -> Iterator[float]:
    """Yield the resident memory of a process without files in MiB until the process ends."""
    while True:
        try:
            found = re.findall(r"(?:RssAnon|RssShmem):\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
        except OSError:
            return
        if not found:
            return
        yield sum(map(int, found)) / 1024


if __name__ == "__main__":
    main()
