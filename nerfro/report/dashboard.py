"""TensorBoard for the logs of many runs, with descriptive run names."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from omegaconf import MISSING
from omegaconf.errors import OmegaConfBaseException

from nerfro.allowed import Range
from nerfro.errors import NerfroError
from nerfro.files.foreign_config import read_foreign_config
from nerfro.paths import scene_name

_LOGS = "tensorboard"  # subfolder of a run folder, see conf/logger/tensorboard.yaml
SEARCH_INTERVAL = 5.0  # seconds between two searches for new runs


@dataclass
class DashboardConfig:
    """Options of `nerfro.dashboard`; conf/dashboard.yaml documents the defaults."""

    outputs: str = MISSING
    host: str = MISSING
    port: Annotated[int, Range(at_least=0, at_most=2**16 - 1)] = MISSING
    open: bool = MISSING


def link_runs(outputs: Path, names: Path) -> int:
    """Link the logs of every run below `outputs` into the folder `names`, because TensorBoard names runs by folder.

    Existing links remain.

    Returns:
        Number of runs.

    Raises:
        NerfroError: the operating system does not allow links.
    """
    logs = sorted(path for path in outputs.rglob(_LOGS) if path.is_dir())
    for path in logs:
        link = names / run_name(path.parent, outputs)
        if link.is_symlink():
            continue
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path.resolve(), target_is_directory=True)
        except OSError as error:
            raise NerfroError(
                f"cannot link {path} to {link} ({error.strerror}); run `tensorboard --logdir {outputs}` instead"
            ) from error
    return len(logs)


def run_name(folder: Path, outputs: Path) -> str:
    """Return the run name `experiment/scene/...`, followed by the path within `outputs` without repetitions."""
    rest = folder.relative_to(outputs).parts
    try:
        config = read_foreign_config(folder / "config.yaml")
        name, scene = _as_folder(config.name), _as_folder(scene_name(config.data.root))
    # The folder is not a run of nerfro, or its configuration is incomplete at this moment.
    except (OmegaConfBaseException, AttributeError, NerfroError):
        return "/".join(rest) or folder.resolve().name
    repeated = {name, "sweeps"}
    return "/".join([name, scene, *(part.removeprefix(f"{name}-{scene}-") for part in rest if part not in repeated)])


def _as_folder(name: str) -> str:
    """Convert a name to a single folder name, so that it cannot refer to another place."""
    return re.sub(r"[^\w.=+-]+", "_", str(name)).strip(".") or "_"


def serve(logs: Path, host: str, port: int) -> str:
    """Start TensorBoard in the background and return its address.

    Raises:
        NerfroError: the host or port cannot be used.
    """
    from tensorboard import program
    from tensorboard.util import tb_logging

    try:
        socket.getaddrinfo(host, None)
    except OSError as error:
        raise NerfroError(f"host={host} is not an address of this machine ({error.strerror}); try localhost") from error
    # Suppress the warning about features that require TensorFlow, which are not used here.
    tb_logging.get_logger().setLevel(logging.ERROR)
    server = program.TensorBoard()
    server.configure(logdir=str(logs), host=host, port=port, reload_interval=SEARCH_INTERVAL)
    with contextlib.redirect_stderr(io.StringIO()):  # suppress the advice to users of the TensorBoard command
        try:
            return server.launch()
        except program.TensorBoardServerException as error:
            raise NerfroError(
                f"{host}:{port} is not available ({error.msg}); give another port, or port=0 for any free port"
            ) from error
