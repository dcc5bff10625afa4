"""Commands in processes that are killed at random moments, and begun again.

A server that has imported what commands import forks the processes, so that starting one takes no seconds.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

_FORKS = multiprocessing.get_context("forkserver")
_PRELOADED = "nerfro", "torch", "lightning", "torchmetrics", "hydra", "omegaconf", "numba", "scipy", "trimesh"
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


def preload() -> None:
    """Have the server import what this process has, which has run such commands; to be called before the first one."""
    modules = [name for name in sys.modules if name.partition(".")[0] in _PRELOADED]
    _FORKS.set_forkserver_preload([*modules, "tests.fuzz.kills"])


def run(name: str, arguments: list[str], log: Path) -> float:
    """Run a command to its end, and say how many seconds it took."""
    begun = time.monotonic()
    process = _FORKS.Process(target=_run, args=(name, arguments, log))
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0, f"{name} ended with {process.exitcode}: {log.read_text()[-2000:]}"
    return time.monotonic() - begun


def kill(name: str, arguments: list[str], log: Path, begun: Path, within: float) -> bool:
    """Kill a command so many seconds after a file of its folder is there, and say whether it still ran.

    So kills are aimed: not at what a process loads, but at what it does.
    """
    process = _FORKS.Process(target=_run, args=(name, arguments, log))
    process.start()
    while process.is_alive() and not begun.exists():
        time.sleep(0.002)
    process.join(within)
    process.kill()
    process.join()
    return process.exitcode == -signal.SIGKILL
