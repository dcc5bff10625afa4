"""Commands in processes that are killed at random moments, and begun again.

A server that has imported everything forks the processes, so that starting one takes a tenth of a second.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
import time
from pathlib import Path

_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["nerfro.train", "nerfro.evaluate", "nerfro.samplers.snell_cpu", "tests.fuzz.kills"])
PATIENCE = 300  # seconds


def _run(name: str, arguments: list[str], log: Path) -> None:
    """In the process: one command, with what it prints in a file."""
    with log.open("a") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    sys.argv = [f"nerfro.{name}", *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    module = importlib.import_module(f"nerfro.{name}")
    module.find_lpips_networks = lambda *files: ({}, {})
    module.main()


def run(name: str, arguments: list[str], log: Path) -> float:
    """Run a command to its end, and say how many seconds it took."""
    begun = time.monotonic()
    process = _FORKS.Process(target=_run, args=(name, arguments, log))
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0, f"{name} ended with {process.exitcode}: {log.read_text()[-2000:]}"
    return time.monotonic() - begun


def kill(name: str, arguments: list[str], log: Path, begun: Path, within: float) -> None:
    """Kill a command so many seconds after a file of its folder is there, that is, after its loading."""
    process = _FORKS.Process(target=_run, args=(name, arguments, log))
    process.start()
    while process.is_alive() and not begun.exists():
        time.sleep(0.005)
    process.join(within)
    process.kill()
    process.join()
