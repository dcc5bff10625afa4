"""Count the Python functions of nerfro and its plugins that one training step calls. Prints Markdown.

    python benchmarks/step_profile.py                       # the default experiment
    python benchmarks/step_profile.py +experiment=glass     # settings of nerfro.train

The script trains four steps of 128 pixels on one core, and reports the third. On one core, no thread prepares the next
batch, so the main thread draws and traces the rays of the step, and the figures include this work. `calls` counts
Python functions, and each resumption of a generator. `moves` counts successive calls of functions in different modules;
`returns` are moves to a module that the step entered before.
"""

from __future__ import annotations

import os

# Before numba and torch start their threads.
os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = "1"

import sys
import tempfile
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parent.parent
_STEP, _NUM_STEPS = 3, 4
# A step begins when Lightning moves its batch to the device.
_BEGIN = "transfer_batch_to_device"


def main() -> None:
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    try:
        if allowed:
            os.sched_setaffinity(0, {min(allowed)})
        calls = calls_of_step(sys.argv[1:])
    finally:
        if allowed:
            os.sched_setaffinity(0, allowed)
    modules = [module for module, _ in calls]
    moves = sum(before != after for before, after in pairwise(modules))
    of_module = Counter(modules)
    print(f"{len(of_module)} modules, {len(set(calls))} functions, {len(calls)} calls, {moves} moves, "
          f"{moves - len(of_module) + 1} returns\n")  # fmt: skip
    print("| module | calls | functions |\n|---|---|---|")
    for module, count in of_module.most_common():
        functions = Counter(function for name, function in calls if name == module).most_common()
        print(f"| {module} | {count} | {', '.join(f'{name} {number}' for name, number in functions)} |")


def calls_of_step(overrides: list[str]) -> list[tuple[str, str]]:
    """Train a few steps, and return the module and function of each call in one of them."""
    calls: list[tuple[str, str]] = []
    step = 0

    def record(frame: FrameType, event: str, argument: object) -> None:
        nonlocal step
        file = frame.f_code.co_filename
        if event != "call" or not file.startswith((f"{ROOT}/nerfro/", f"{ROOT}/plugins/")):
            return
        step += frame.f_code.co_name == _BEGIN
        if step == _STEP:
            module = file.removeprefix(f"{ROOT}/").removesuffix(".py").replace("/", ".")
            calls.append((module, frame.f_code.co_qualname if sys.version_info >= (3, 11) else frame.f_code.co_name))

    from nerfro.train import main as train

    with tempfile.TemporaryDirectory() as folder:
        sys.argv = [
            "nerfro.train", "batches.size=128", f"trainer.max_steps={_NUM_STEPS}", "trainer.max_time=null",
            "evaluation.split=null", "evaluation.every=0", f"hydra.run.dir={folder}", *overrides,
        ]  # fmt: skip
        sys.setprofile(record)
        try:
            train()
        finally:
            sys.setprofile(None)
    return calls


if __name__ == "__main__":
    main()
