"""Stages of `python -m nerfro.reconstruct`: commands whose results are reused until their input files change."""

from __future__ import annotations

import contextlib
import itertools
import shlex
import signal
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from nerfro.capture.photographs import PHOTOGRAPH_SUFFIXES, place_photograph
from nerfro.cli import EXIT_INTERRUPTED
from nerfro.data.frames import list_images
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.errors import Interrupted, NerfroError
from nerfro.files.folder_lock import environment_of_stages
from nerfro.progress import track
from nerfro.trust import command_of_module

_INTERRUPTED = (EXIT_INTERRUPTED, -signal.SIGINT, -signal.SIGTERM)  # exit statuses


@dataclass(frozen=True)
class Stage:
    """A command of nerfro with its input and output files.

    Attributes:
        command: name of the command, as in `python -m nerfro.COMMAND`.
        options: command-line options.
        result: the last file that the command writes.
        preview: file or folder that the user should check.
        inputs: files that the command reads; the command is repeated if one of them is newer than the result.
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

    def run(self) -> None:
        """Run the command unless the stage is done.

        Raises:
            NerfroError: the command failed.
            Interrupted: the command was interrupted.
        """
        if self.is_done:
            print(f"{self.command}: done; {self.result} is kept (delete the file to repeat the stage)", flush=True)
            return
        module = f"nerfro.{self.command}"
        print(f"\n{self.command}: {shlex.join(['python', '-m', module, *self.options])}", flush=True)
        status = run_command([*command_of_module(module), *self.options])
        if status in _INTERRUPTED:
            raise Interrupted(f"{self.command} is incomplete; repeat the same command to continue")
        if status != 0 or not self.result.is_file():
            raise NerfroError(
                f"{self.command} failed for the reason in the line above; correct the input, set "
                f"{self.command}='OPTIONS', or run the printed command with other options; then repeat this command, "
                "which keeps all completed stages"
            )
        print(f"{self.command}: done; look at {self.preview}", flush=True)


def is_older(file: Path, others: Iterable[Path]) -> bool:
    """Test whether one of the existing other files was modified after a file."""
    written = file.stat().st_mtime_ns
    return any(other.stat().st_mtime_ns > written for other in others if other.exists())


def run_command(command: list[str]) -> int:
    """Run a command and return the exit status. On SIGTERM or Ctrl-C, wait until the command has saved its work."""
    process: subprocess.Popen[bytes] | None = None
    terminates = False

    def forward(number: int, frame: FrameType | None) -> None:
        nonlocal terminates
        terminates |= number == signal.SIGTERM  # the terminal sends Ctrl-C to the command as well
        if terminates and process is not None:
            process.terminate()

    previous = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        process = subprocess.Popen(command, env=environment_of_stages())
        if terminates:  # the signal arrived before the command had started
            process.terminate()
        while process.poll() is None:
            # Without a limit, the second of two signals in quick succession would be handled after the command.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=1)
        return process.returncode
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def move_aside(folder: Path) -> Path:
    """Rename a folder to the first free name with a number, and return the new path."""
    free = next(path for n in itertools.count(1) if not (path := folder.with_name(f"{folder.name}_{n}")).exists())
    return folder.rename(free)


def link_photographs(photographs: Path, masks: Path | None, out: Path) -> None:
    """Link photographs into `out`/images and masks into `out`/masks, so that no result lies among the originals.

    Existing links and files are kept, except links to deleted files. Photographs in HEIC format and those with an EXIF
    orientation are converted.

    Args:
        photographs: folder of the photographs, which may also contain masks (`mask_*`).
        masks: folder of the masks, `<photograph>.png` or `mask_<photograph>.png`.
        out: folder of the data set.
    """
    list_images(photographs, PHOTOGRAPH_SUFFIXES)  # raises an error for a folder without photographs
    for link in (*out.glob("images/*"), *out.glob("masks/*")):
        if not link.exists():
            link.unlink()
    for folder in (photographs, *([] if masks is None else [masks])):
        if not folder.is_dir():
            raise NerfroError(f"masks={folder} is not a folder; give the folder of the masks of the photographs")
        suffixes = PHOTOGRAPH_SUFFIXES if folder == photographs else IMAGE_SUFFIXES
        files = (file for file in folder.iterdir() if file.suffix.lower() in suffixes)
        for file in track("linking", sorted(file for file in files if not file.name.startswith("."))):
            among_images = folder == photographs or file.name.startswith("mask_")
            place = out / ("images" if among_images else "masks")
            place.mkdir(parents=True, exist_ok=True)
            if folder == photographs:
                place_photograph(file, place)
            elif not (place / file.name).exists():
                (place / file.name).symlink_to(file.resolve())
