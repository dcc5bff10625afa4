"""TensorBoard on the logs of many runs, each under a name that tells what it is."""

from __future__ import annotations

import contextlib
import io
import logging
from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.errors import NerfroError
from nerfro.training.sweeps import scene_name

_LOGS = "tensorboard"  # the folder in a run folder, see conf/logger/tensorboard.yaml
LOOK_AGAIN = 5.0  # seconds between two searches for new runs


@dataclass
class DashboardConfig:
    """Options of `nerfro.dashboard`; conf/dashboard.yaml gives and explains the defaults."""

    outputs: str = MISSING
    host: str = MISSING
    port: int = MISSING
    open: bool = MISSING


def link_runs(outputs: Path, names: Path) -> int:
    """Make a link to the logs of every run: TensorBoard calls runs by their folders.

    Args:
        outputs: searched for run folders at any depth.
        names: folder for the links; those that are there stay.

    Returns:
        Number of runs.
    """
    logs = sorted(path for path in outputs.rglob(_LOGS) if path.is_dir())
    for path in logs:
        link = names / run_name(path.parent, outputs)
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path.resolve(), target_is_directory=True)
    return len(logs)


def run_name(folder: Path, outputs: Path) -> str:
    """`experiment/scene/` and what tells the run from others: where it lies in `outputs`, without what was said."""
    rest = folder.relative_to(outputs).parts
    try:
        config = OmegaConf.load(folder / "config.yaml")
        name, scene = str(config.name), scene_name(config.data.root)
    except (OSError, OmegaConfBaseException, AttributeError):  # no run of ours, or one that is just being written
        return "/".join(rest) or folder.resolve().name
    said = {name, "sweeps"}
    return "/".join([name, scene, *(part.removeprefix(f"{name}-{scene}-") for part in rest if part not in said)])


def serve(logs: Path, host: str, port: int) -> str:
    """Start TensorBoard in the background and return its address.

    Raises:
        NerfroError: the port is taken.
    """
    from tensorboard import program
    from tensorboard.util import tb_logging

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
