"""Commands one after the other, each made of the files of those before; what is there already is kept."""

from __future__ import annotations

import itertools
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from nerfro.cli import EXIT_INTERRUPTED
from nerfro.data.frames import list_images
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.errors import Interrupted, NerfroError

_INTERRUPTED = (EXIT_INTERRUPTED, -signal.SIGINT, -signal.SIGTERM)  # exit statuses


@dataclass(frozen=True)
class Stage:
    """A command of nerfro, and what is there when it is done.

    Attributes:
        command: its name, as in `python -m nerfro.COMMAND`.
        options: of the command.
        result: the file that it writes last.
        look_at: what a person should look at.
        made_of: files that it reads; where one is newer than the result, the command is run again.
    """

    command: str
    options: Sequence[str]
    result: Path
    look_at: Path
    made_of: Sequence[Path] = ()

    @property
    def is_done(self) -> bool:
        """Whether the result is there, and nothing that it is made of has changed since."""
        return self.result.is_file() and not is_older(self.result, self.made_of)

    def run(self) -> None:
        """Run the command unless it is done, and say which it is.

        Raises:
            NerfroError: it failed.
            Interrupted: it was interrupted.
        """
        if self.is_done:
            print(f"{self.command}: done; {self.result} is kept (to make it again, delete it)", flush=True)
            return
        options = [*self.options]
        print(f"\n{self.command}: {shlex.join(['python', '-m', f'nerfro.{self.command}', *options])}", flush=True)
        status = finished([sys.executable, "-m", f"nerfro.{self.command}", *options])
        if status in _INTERRUPTED:
            raise Interrupted(f"to go on, start the same command again; {self.command} is not done")
        if status != 0 or not self.result.is_file():
            raise NerfroError(
                f"{self.command} failed, and the line above says why; mend that, give {self.command}='OPTIONS', or run "
                "its command yourself with others; then start this again: what is done is kept"
            )
        print(f"{self.command}: done; look at {self.look_at}", flush=True)


def is_older(file: Path, others: Iterable[Path]) -> bool:
    """Whether one of some other files has changed after a file; those that do not exist have not."""
    written = file.stat().st_mtime_ns
    return any(other.stat().st_mtime_ns > written for other in others if other.exists())


def finished(command: list[str]) -> int:
    """The exit status of a command, which is left time to save its work when this process is asked to end."""
    process = subprocess.Popen(command)

    def pass_on(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM:  # Ctrl-C reaches the command without us
            process.terminate()

    previous = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return process.wait()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def option(name: str, value: object) -> str:
    """`name=value`, the value quoted where Hydra would not take it for one text."""
    text = str(value)
    if not re.fullmatch(r"[\w./+@%-]+", text, re.ASCII):
        text = '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return f"{name}={text}"


def move_aside(folder: Path) -> Path:
    """Rename a folder, so that its name is free; returns the new one."""
    free = next(path for n in itertools.count(1) if not (path := folder.with_name(f"{folder.name}_{n}")).exists())
    return folder.rename(free)


def gather(photographs: Path, masks: Path | None, out: Path) -> None:
    """Links to photographs in `out`/images, and to masks where loaders look for them.

    So what is made later lies in `out`, and not among the photographs. Links and files that exist are kept.

    Args:
        photographs: their folder; `mask_*` files in it come along.
        masks: folder of `<photograph>.png` or `mask_<photograph>.png`, if there is one.
        out: the data set's folder.
    """
    list_images(photographs)  # refuses a folder without any
    for folder in (photographs, *([] if masks is None else [masks])):
        if not folder.is_dir():
            raise NerfroError(f"masks={folder} is not a folder; give the one that holds the photographs' masks")
        for file in sorted(folder.iterdir()):
            if file.suffix.lower() not in IMAGE_SUFFIXES or file.name.startswith("."):
                continue
            among_images = folder == photographs or file.name.startswith("mask_")
            link = out / ("images" if among_images else "masks") / file.name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.unlink(missing_ok=True)  # one that leads nowhere
                link.symlink_to(file.resolve())
