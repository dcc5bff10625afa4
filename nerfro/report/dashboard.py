"""TensorBoard on the logs of many runs, each under a name that tells what it is."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from omegaconf import MISSING
from omegaconf.errors import OmegaConfBaseException

from nerfro.allowed import Range
from nerfro.errors import NerfroError
from nerfro.files.foreign_config import foreign_config
from nerfro.training.sweeps import scene_name

_LOGS = "tensorboard"  # the folder in a run folder, see conf/logger/tensorboard.yaml
LOOK_AGAIN = 5.0  # seconds between two searches for new runs


@dataclass
class DashboardConfig:
    """Options of `nerfro.dashboard`; conf/dashboard.yaml gives and explains the defaults."""

    outputs: str = MISSING
    host: str = MISSING
    port: Annotated[int, Range(at_least=0, at_most=2**16 - 1)] = MISSING
    open: bool = MISSING


def link_runs(outputs: Path, names: Path) -> int:
    """Link the logs of every run at any depth of `outputs` into the folder `names`, and return the number of runs.

    TensorBoard calls runs by folders. Links that are there stay; where links are not allowed, copies are made and grow.
    """
    logs = sorted(path for path in outputs.rglob(_LOGS) if path.is_dir())
    for path in logs:
        link = names / run_name(path.parent, outputs)
        if link.is_symlink():
            continue
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(path.resolve(), target_is_directory=True)
                continue
        except OSError:  # Windows lets administrators alone make links
            link.mkdir()
        _copy_new(path, link)
    return len(logs)


def _copy_new(logs: Path, copies: Path) -> None:
    """Append to copies of files that only grow what they do not have yet."""
    for path in logs.glob("events.*"):
        with path.open("rb") as source, (copies / path.name).open("ab") as copy:
            source.seek(copy.tell())
            shutil.copyfileobj(source, copy)


def run_name(folder: Path, outputs: Path) -> str:
    """`experiment/scene/` and what tells the run from others: where it lies in `outputs`, without what was said."""
    rest = folder.relative_to(outputs).parts
    try:
        path = folder / "config.yaml"
        config = foreign_config(path.read_text(encoding="utf-8"), path)
        name, scene = _as_folder(config.name), _as_folder(scene_name(config.data.root))
    # No run of ours, or one that is just being written.
    except (OSError, UnicodeDecodeError, OmegaConfBaseException, AttributeError, NerfroError):
        return "/".join(rest) or folder.resolve().name
    said = {name, "sweeps"}
    return "/".join([name, scene, *(part.removeprefix(f"{name}-{scene}-") for part in rest if part not in said)])


def _as_folder(name: str) -> str:
    """A name from a run's file as that of one folder: it leads nowhere else."""
    return re.sub(r"[^\w.=+-]+", "_", str(name)).strip(".") or "_"


def serve(logs: Path, host: str, port: int) -> str:
    """Start TensorBoard in the background and return its address."""
    from tensorboard import program
    from tensorboard.util import tb_logging

    try:
        socket.getaddrinfo(host, None)
    except OSError as error:
        raise NerfroError(f"host={host} is no address of this machine ({error.strerror}); try localhost") from error
    # Its warning about reduced functions without TensorFlow; nothing here needs it.
    tb_logging.get_logger().setLevel(logging.ERROR)
    server = program.TensorBoard()
    server.configure(logdir=str(logs), host=host, port=port, reload_interval=LOOK_AGAIN)
    with contextlib.redirect_stderr(io.StringIO()):  # its advice to its own users
        try:
            return server.launch()
        except program.TensorBoardServerException as error:
            raise NerfroError(
                f"{host}:{port} cannot be served on ({error.msg}); give another port, or port=0"
            ) from error
