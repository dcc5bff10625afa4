"""Measure the processor time of starts, and the sizes of the wheel and of the packages that nerfro needs.

    python benchmarks/installation.py

The best of several turns counts. Sizes are those of the files that pip has installed, in units of 10^6 bytes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

STARTS = {
    "import torch": ["-c", "import torch"],
    "import lightning.pytorch": ["-c", "import lightning.pytorch"],
    "import nerfro": ["-c", "import nerfro"],
    "nerfro --help": ["-m", "nerfro", "--help"],
    "nerfro train --help": ["-m", "nerfro", "train", "--help"],
    "nerfro train, with a misspelt option": ["-m", "nerfro", "train", "sed=1"],
    "nerfro train --cfg job": ["-m", "nerfro", "train", "--cfg", "job"],
    "nerfro plugins": ["-m", "nerfro", "plugins"],
}
PROJECT = Path(__file__).resolve().parent.parent


def processor_time(arguments: list[str]) -> float:
    """Return the processor time of a Python process in seconds."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    usage = os.wait4(process.pid, 0)[2]
    return usage.ru_utime + usage.ru_stime


def requirements(package: str) -> set[str]:
    """Return the names of the packages that a package needs, without extras."""
    needed = map(Requirement, distribution(package).requires or ())
    return {
        canonicalize_name(need.name) for need in needed if need.marker is None or need.marker.evaluate({"extra": ""})
    }


def dependents(package: str) -> dict[str, set[str]]:
    """Return all direct and indirect requirements of a package, each with the packages that need it."""
    found: dict[str, set[str]] = {}
    waiting = [package]
    while waiting:
        needing = waiting.pop()
        try:
            needed = requirements(needing)
        except PackageNotFoundError:  # a requirement that is not installed
            continue
        waiting += needed - found.keys()
        for name in needed:
            found.setdefault(name, set()).add(needing)
    return found


def megabytes(package: str) -> float:
    """Return the size of the installed files of a package."""
    try:
        files = distribution(package).files or ()
    except PackageNotFoundError:
        return 0.0
    paths = (Path(str(file.locate())) for file in files)
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def wheel_megabytes() -> float:
    """Build the wheel and return its size."""
    from hatchling.builders.wheel import WheelBuilder

    with tempfile.TemporaryDirectory() as folder:
        (wheel,) = WheelBuilder(str(PROJECT)).build(directory=folder, versions=["standard"])
        return Path(wheel).stat().st_size / 1e6


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=5, help="processes of each start")
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS), help="starts to be measured")
    parser.add_argument("--least", type=float, default=10, help="size of the smallest package with its own row, MB")
    options = parser.parse_args()

    print("| start | processor time, s | ratio to the first row |\n|---|---|---|")
    seconds = {start: min(processor_time(STARTS[start]) for _ in range(options.turns)) for start in options.starts}
    for start, time in seconds.items():
        print(f"| `{start}` | {time:.2f} | {time / seconds[options.starts[0]]:.2f} |")

    needing = dependents("nerfro")
    sizes = {package: megabytes(package) for package in needing}
    print("\n| package | MB | needed by |\n|---|---|---|")
    for package in sorted(sizes, key=sizes.__getitem__, reverse=True):
        if sizes[package] >= options.least:
            print(f"| {package} | {sizes[package]:.0f} | {', '.join(sorted(needing[package]))} |")
    small = [size for size in sizes.values() if size < options.least]
    print(f"| {len(small)} others | {sum(small):.0f} | |\n| all | {sum(sizes.values()):.0f} | |")
    print(f"| the wheel of nerfro | {wheel_megabytes():.1f} | |")
