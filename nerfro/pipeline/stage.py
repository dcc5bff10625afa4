"""A stage of `nerfro.reconstruct`, whose results are kept until an input file changes."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TypeVar

import torch

from nerfro.cli.failures import in_one_line
from nerfro.cli.overrides import command_line
from nerfro.core.errors import Interrupted, NerfroError
from nerfro.pipeline.options import STAGES

Value = TypeVar("Value")


@dataclass(frozen=True)
class Stage:
    """A stage with input and output files.

    Attributes:
        command: name of the command that does the same, as in `python -m nerfro.COMMAND`.
        options: options of this command.
        result: the last file that the stage writes.
        preview: file or folder that the user should check.
        inputs: files that the stage reads; the stage is repeated if one of them is newer than the result.
    """

    command: str
    options: Sequence[str]
    result: Path
    preview: Path
    inputs: Sequence[Path] = ()

    @property
    def is_done(self) -> bool:
        """Whether the result exists and no input is newer."""
        return self.result.is_file() and not is_older(self.result, self.inputs)

    def run(self, work: Callable[[], Value], read: Callable[[], Value]) -> Value:
        """Return the value of the stage.

        Args:
            work: function that computes the value and writes the files.
            read: function that reads the value from files, for a stage that is done.

        Raises:
            NerfroError: the stage failed.
            Interrupted: the stage was interrupted.
        """
        if self.is_done:
            # The other files of a run would resume its training.
            kept = self.result.parent if self.command == "train" else self.result
            print(f"{self.command}: done; {kept} is kept (delete it to repeat the stage)", flush=True)
            return read()
        print(f"\n{self.command}: {command_line(self.command, self.options)}", flush=True)
        try:
            with torch.random.fork_rng(devices=[]):  # a stage depends on no random numbers of earlier stages
                torch.manual_seed(67280421310721)  # that of torch in a new process
                value = work()
            if not self.result.is_file():
                raise NerfroError(f"{self.result} was not written")
        except KeyboardInterrupt:
            # Training has saved a checkpoint.
            again = "continue" if self.command == "train" else "start this stage again"
            raise Interrupted(f"{self.command} is incomplete; repeat the same command to {again}") from None
        except Exception as error:
            if os.environ.get("NERFRO_DEBUG"):
                raise
            option = f"set {self.command}='OPTIONS', " if self.command in STAGES else ""
            raise NerfroError(
                f"{self.command} failed: {in_one_line(error)}; correct the input, {option}or run the printed command "
                "with other options; then repeat this command, which keeps all completed stages"
            ) from error
        gc.collect()  # models refer to themselves
        print(f"{self.command}: done; look at {self.preview}", flush=True)
        return value


@contextlib.contextmanager
def terminated_in_one_line() -> Iterator[None]:
    """End this program on SIGTERM in the same way as on Ctrl-C. A second SIGTERM ends the program immediately."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def is_older(file: Path, others: Iterable[Path]) -> bool:
    """Test whether one of the existing other files was modified after a file."""
    written = file.stat().st_mtime_ns
    return any(other.stat().st_mtime_ns > written for other in others if other.exists())


def move_aside(folder: Path) -> Path:
    """Rename a folder to the first free name with a number, and return the new path."""
    free = next(path for n in itertools.count(1) if not (path := folder.with_name(f"{folder.name}_{n}")).exists())
    return folder.rename(free)
