"""Commands in separate processes, which tests interrupt, kill and restart.

A server that has imported what commands import forks the processes, so that starting one takes no seconds.
"""

import contextlib
import importlib
import multiprocessing
import os
import re
import signal
import sys
import time
from pathlib import Path

_FORKS = multiprocessing.get_context("forkserver")
_PRELOADED = "nerfro", "torch", "lightning", "torchmetrics", "hydra", "omegaconf", "numba", "scipy", "trimesh"
PATIENCE = 300  # seconds


def _main(name: str, arguments: list[str], log: Path, environment: dict[str, str]) -> None:
    """In the process: one command, with what it prints in files."""
    for stream, path in ((sys.stdout, log), (sys.stderr, _errors(log))):
        with path.open("a") as file:
            os.dup2(file.fileno(), stream.fileno())
    sys.argv = [f"nerfro.{name}", *arguments]
    os.environ.update(environment, HYDRA_FULL_ERROR="1")
    importlib.import_module(f"nerfro.{name}").main()


def _errors(log: Path) -> Path:
    return log.with_name(f"{log.name}_errors")


class Command:
    """A command that has been started.

    Args:
        name: of its module in the package.
        arguments: of the command line.
        log: file to which its standard output is added; its errors are in one beside it.
        environment: variables that it has beside those of the tests.
    """

    def __init__(self, name: str, arguments: list[str], log: Path, **environment: str) -> None:
        # Only what is imported before the server starts is preloaded; later calls change nothing.
        modules = [module for module in sys.modules if module.partition(".")[0] in _PRELOADED]
        _FORKS.set_forkserver_preload([*modules, __name__])
        self._log, self._name = log, name
        self._process = _FORKS.Process(target=_main, args=(name, arguments, log, environment))
        self._process.start()

    @property
    def runs(self) -> bool:
        return self._process.is_alive()

    @property
    def printed(self) -> str:
        """All that is in the log until now."""
        return self._log.read_text() if self._log.exists() else ""

    @property
    def errors(self) -> str:
        """All that is in the file of errors until now."""
        return _errors(self._log).read_text() if _errors(self._log).exists() else ""

    def until(self, pattern: str) -> re.Match[str]:
        """Wait for lines in the log, and say where it has them; ^ and $ are a line's ends."""
        deadline = time.monotonic() + PATIENCE
        while (found := re.search(pattern, self.printed, re.MULTILINE)) is None:
            assert self.runs, f"{self._name} ended before it said '{pattern}': {self.errors[-2000:]}"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        return found

    def send(self, number: signal.Signals) -> None:
        assert self._process.pid is not None
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(self._process.pid, number)

    def wait(self, seconds: float = PATIENCE) -> int | None:
        """Its exit code when it has ended, negative if a signal did; None if it has not after so many seconds."""
        self._process.join(seconds)
        return self._process.exitcode

    def finished(self) -> str:
        """What it has printed when it has ended well."""
        code = self.wait()
        assert code == 0, f"{self._name} ended with {code}: {self.errors[-2000:]}"
        return self.printed


def run(name: str, arguments: list[str], log: Path) -> None:
    """Run a command to its end."""
    Command(name, arguments, log).finished()


def kill(name: str, arguments: list[str], log: Path, begun: Path, within: float) -> bool:
    """Kill a command so many seconds after a file of its folder is there, and say whether it still ran.

    So kills are aimed: not at what a process loads, but at what it does.
    """
    command = Command(name, arguments, log)
    while command.runs and not begun.exists():
        time.sleep(0.002)
    if command.wait(within) is None:
        command.send(signal.SIGKILL)
    return command.wait() == -signal.SIGKILL
