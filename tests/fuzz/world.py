"""A small data set and a trained run, commands that are run on them in this process, and what holds whatever they get.

A command that is given anything ends within a minute of processor time: it either does what it was asked, or says in
one line why not and has a status other than zero. It writes to its own folder only, and what existed stays as it was.
"""

import contextlib
import faulthandler
import importlib
import io
import json
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from nerfro.cli.failures import in_one_line
from nerfro.core.errors import NerfroError
from nerfro.files import cache

SECONDS = 60  # of processor time, because other programs share the cores
_WAITING = 10  # times as many seconds end what waits
# Progress bars are no lines of the report.
_BAR = re.compile(r"^(train|evaluate|reading|looking for|cutting|distances|occupancy|smoothing)\b.*")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    lines: list[str]  # on standard error, without bars
    out: str
    seconds: float


class World:
    """A folder with everything that commands of a campaign read and write.

    Attributes:
        root: the folder; `data` and `run` in it are never to change.
    """

    def __init__(self, root: Path, data: Path, small: list[str]) -> None:
        self.root, self.small = root, [text for text in small if not text.startswith("data.root=")]
        shutil.copytree(data, root / "data")
        self.caught = root / "caught"  # where an unforeseen error's traceback goes
        self.caught.mkdir()
        ended = self.command("train", *self.train_options(root / "data"), f"hydra.run.dir={root / 'run'}", seconds=600)
        assert ended.code == 0, ended.lines

    def train_options(self, data: Path) -> list[str]:
        """A run of one step that is watched by nobody."""
        return [
            f"data.root={data}",
            f"medium.mesh={data}/mesh.ply",
            *self.small,
            "trainer.max_steps=1",
            "trainer.max_time=00:00:00:10",  # for those that ask for more steps
            "evaluation.every=0",
            "evaluation.subdivision.side=1",
            "batches.subdivision.side=1",
        ]

    def command(self, name: str, *arguments: str, seconds: int = SECONDS) -> Ended:
        """Run `python -m nerfro.<name>` in this process."""
        module = importlib.import_module(f"nerfro.{name}")
        out, err = io.StringIO(), io.StringIO()
        begun, code = time.process_time(), 0
        patches = [mock.patch.object(sys, "argv", [f"nerfro.{name}", *arguments])]
        patches += [mock.patch.dict(os.environ, {"HYDRA_FULL_ERROR": "1"})]
        # Compiled kernels stay where they are.
        patches += [mock.patch.object(cache, "cache_dir", return_value=self.root / "cache")]
        patches += [mock.patch.object(tempfile, "tempdir", str(self.caught))]
        with contextlib.ExitStack() as stack:
            for patch in patches:
                stack.enter_context(patch)
            stack.enter_context(warnings.catch_warnings())
            stack.enter_context(contextlib.redirect_stdout(out))
            stack.enter_context(contextlib.redirect_stderr(err))
            stack.enter_context(_alarm(seconds))
            try:
                module.main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
        lines = [line.strip() for line in re.split("[\r\n]", err.getvalue()) if line.strip()]
        lines = [line for line in lines if not _BAR.match(line)]
        return Ended(code, lines, out.getvalue(), time.process_time() - begun)

    def trouble(self, name: str, *arguments: str, own: tuple[Path, ...] = ()) -> str | None:
        """Run a command and say what does not hold; None if all does. It may write to folders of its `own`."""
        before = self._state(own)
        try:
            ended = self.command(name, *arguments)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            return f"{type(error).__name__}: {error}"
        changed = sorted(str(p) for p, _ in set(before.items()) ^ set(self._state(own).items()))
        text = " / ".join(ended.lines)
        if ended.seconds > SECONDS:
            return f"took {ended.seconds:.0f} s: {text}"
        if changed:
            return f"changed {', '.join(changed[:4])}: status {ended.code}: {text}"
        if ended.code not in (0, 1):
            return f"status {ended.code}: {text}"
        if ended.code == 0:
            if ended.lines:
                return f"status 0, and says: {text}"
            return next((bad for folder in own if (bad := _not_finite(folder))), None)
        if len(ended.lines) != 1 or not ended.lines[0].startswith("nerfro: error: "):
            return f"not one line: {text}"
        if "this is a bug of nerfro" in text:
            return text
        return None

    def trouble_of_reader(self, read: Callable[[], None], what: str) -> str | None:
        """Run a reader and say what does not hold: it succeeds, or raises an error with a message in one line."""
        begun, found = time.process_time(), None
        try:
            with contextlib.ExitStack() as stack:
                stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
                stack.enter_context(contextlib.redirect_stderr(io.StringIO()))
                stack.enter_context(warnings.catch_warnings())
                stack.enter_context(_alarm(SECONDS))
                warnings.simplefilter("ignore")
                read()
        except NerfroError as error:
            message = in_one_line(error)
            found = (
                f"a line of {len(message)} characters: {message[:200]}"
                if len(message) > 1010 or "\n" in message
                else None
            )
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            found = f"{type(error).__name__}: {str(error)[:200]} ({place.filename}:{place.lineno})"
        if time.process_time() - begun > SECONDS / 2:
            found = f"took {time.process_time() - begun:.0f} s"
        return None if found is None else f"{what}: {found}"

    def clean(self) -> None:
        """Remove everything that cases have written."""
        for path in self.root.iterdir():
            if path.name not in ("data", "run", "cache", "caught", "formats"):
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()

    def _state(self, own: tuple[Path, ...]) -> dict[Path, tuple[int, int] | None]:
        """Every file and folder outside of some, with size and time."""
        ignored = (*own, self.root / "cache")
        found = {}
        for path in self.root.rglob("*"):
            if not any(path == folder or path.is_relative_to(folder) for folder in ignored):
                status = path.lstat()
                found[path] = None if path.is_dir() else (status.st_size, status.st_mtime_ns)
        return found


def _not_finite(folder: Path) -> str | None:
    """What a command has written that is no number."""
    for file in folder.rglob("*.npz"):
        with np.load(file) as arrays:
            bad = [name for name in arrays.files if not np.isfinite(arrays[name]).all()]
        if bad:
            return f"{file.name}: {bad} not finite"
    for file in folder.rglob("metrics.json"):
        psnr = json.loads(file.read_text())["test"]["psnr"]
        if psnr is not None and not math.isfinite(psnr):
            return f"psnr={psnr}"
    return None


@contextlib.contextmanager
def _alarm(seconds: int) -> Iterator[None]:
    """End what takes too long, or waits."""
    seconds *= _WAITING

    def end(*_: object) -> None:
        raise TimeoutError(f"more than {seconds} s")

    previous = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    faulthandler.dump_traceback_later(
        2 * seconds, exit=True, file=sys.__stderr__
    )  # for code that Python cannot interrupt
    try:
        yield
    finally:
        signal.alarm(0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, previous)
