"""Cells of a sweep, each of which is one training run: configuration, state and execution.

The state is stored in the folders of the cells, so that a sweep can be stopped at any time and resumed later.
`hydra_plugins/nerfro_cells.py` plans and launches cells; a launcher's worker runs each of them through `CellTask`.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfro.allowed import check_names, check_settings
from nerfro.cli import in_one_line
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.folder_lock import is_locked, lock_folder
from nerfro.paths import EMBEDDED_PREFIX, resolve_path
from nerfro.registry import build, discover
from nerfro.scenes import SCENES
from nerfro.training.config import TrainConfig
from nerfro.training.run_folder import CELL_FILE, CONFIG_FILE
from nerfro.training.settings import RESULT, first_difference, settings

# Larger data files are identified by name and size, because reading them would take minutes.
_MAX_HASHED = 64 * 2**20  # bytes

# Overrides that names of folders contain without `key=`.
_NAMED_BY_THEMSELVES = ("+experiment", "data.root", "seed")


class State(str, Enum):
    """State of a cell."""

    OPEN = "not finished"
    RUNNING = "running in another process"
    FINISHED = "finished"
    FAILED = "failed"
    REFUSED = "refused"


@dataclass(frozen=True)
class Identity:
    """Identity of a cell: cells with equal identities have equal results, except for the machine."""

    settings: Mapping[str, Any]  # settings that change the result, by full name
    data: str  # hash of the files in the data folder

    @classmethod
    def of(cls, config: DictConfig) -> Identity:
        """Compute the identity of a run; only names and sizes of images are read."""
        return cls(settings(config, RESULT), _hash_of_files(resolve_path(config.data.root)))

    def difference(self, record: Mapping[str, Any]) -> str | None:
        """Describe the first difference between the record of a cell and this identity; None if they are equal."""
        old = settings(record["settings"], RESULT)
        key = first_difference(old, self.settings)
        if key is not None:
            return f"{key}={old.get(key)}, now {self.settings.get(key)}"
        return None if record["data"] == self.data else "other files in its data's folder"


@dataclass(frozen=True)
class Cell:
    """One training run of a sweep."""

    overrides: list[str]  # overrides of the configuration, including the folder
    folder: Path  # folder of the run
    identity: Identity | None  # None for a cell that cannot run
    refusal: str | None  # reason why the cell cannot run, or None

    def state(self) -> tuple[State, str]:
        """Return the state, and the reason for a failure or refusal."""
        return (
            (State.REFUSED, self.refusal or "") if self.identity is None else _current_state(self.folder, self.identity)
        )


def refusal(config: DictConfig) -> str | None:
    """Return the reason why a cell cannot run, as far as inexpensive checks find one; None without a reason."""
    try:
        check_names(config)
        check_settings(config, TrainConfig)
    except NerfroError as error:
        return str(error)
    try:
        if "train" in build(config.data).splits:
            return None
        reason = f"data.root={config.data.root} has no training views"
    except NerfroError as error:
        reason = str(error)
    scene = scene_name(config.data.root)
    if scene in SCENES and not str(config.data.root).startswith(EMBEDDED_PREFIX):
        out = Path(config.data.root)
        small = "resolution=128 spp=256 test_spp=1024 views.val=10 views.test=20"
        return f"{out} holds no data yet: python -m nerfro.synthesize scene={scene} out={out} {small}"
    return reason


def scene_name(root: str) -> str:
    """Return the last component of the path of a data folder."""
    return Path(str(root).removeprefix(EMBEDDED_PREFIX)).name


def folder_name(config: DictConfig, swept: Sequence[str]) -> str:
    """Compose the name of the folder of a cell: experiment, scene, seed and other swept settings."""
    others = [override for override in swept if override.split("=", 1)[0] not in _NAMED_BY_THEMSELVES]
    short = [f"{key.lstrip('+').rpartition('.')[2]}={value}" for key, _, value in (o.partition("=") for o in others)]
    name = "-".join([config.name, scene_name(config.data.root), f"seed{config.seed}", *short])
    return re.sub(r"[^\w.=+-]+", "_", name).strip("_")


class CellTask:
    """Run a cell and record its state; a failure does not end the sweep.

    A cell that was stopped resumes from its checkpoint.
    """

    def __init__(self, task: Callable[[DictConfig], None]) -> None:
        self._task = task

    def __call__(self, config: DictConfig) -> None:
        discover()  # the worker may be a new process
        folder = Path(HydraConfig.get().runtime.output_dir)
        if is_locked(folder):
            return  # a process of an earlier start of the sweep runs the cell
        with lock_folder(folder, "hydra.sweep.dir"):
            self._run(config, folder)

    def _run(self, config: DictConfig, folder: Path) -> None:
        identity = Identity.of(config)
        if _recorded(folder, identity)[0] is State.FINISHED:
            return
        if (folder / CONFIG_FILE).is_file():
            config.ckpt_path = "last"
        _record(folder, identity, State.OPEN)
        try:
            self._task(config)
        except Exception as error:  # the other cells continue after any error
            reason = in_one_line(error)
            print(f"nerfro: {folder.name} failed: {reason}", file=sys.stderr, flush=True)
            _record(folder, identity, State.FAILED, reason)
        else:
            _record(folder, identity, State.FINISHED)


def _record(folder: Path, identity: Identity, state: State, reason: str = "") -> None:
    record = {
        "state": state.value,
        "reason": reason,
        "data": identity.data,
        "settings": identity.settings,
    }
    write_atomically(folder / CELL_FILE, json.dumps(record, indent=2) + "\n")


def _current_state(folder: Path, identity: Identity) -> tuple[State, str]:
    return (State.RUNNING, "") if is_locked(folder) else _recorded(folder, identity)


def _recorded(folder: Path, identity: Identity) -> tuple[State, str]:
    holds_a_run = (folder / CONFIG_FILE).is_file()
    try:
        record = json.loads((folder / CELL_FILE).read_text(encoding="utf-8"))
        different, state, reason = identity.difference(record), State(record["state"]), str(record["reason"])
    except FileNotFoundError:
        return (State.REFUSED, f"{folder} holds a run that is no cell of a sweep") if holds_a_run else (State.OPEN, "")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return State.REFUSED, f"{folder / CELL_FILE} is damaged; choose another hydra.sweep.dir or remove its folder"
    if different is not None:
        if not holds_a_run:
            return State.OPEN, ""
        return State.REFUSED, f"{folder} holds a run with {different}; choose another hydra.sweep.dir or remove it"
    if state is State.FINISHED and not (folder / "metrics.json").is_file():
        return State.OPEN, ""
    return state, reason


def _hash_of_files(root: Path) -> str:
    """Hash the names and sizes of all files below a folder, and the content of files other than images."""
    digest = hashlib.sha256()
    for file in sorted(_visible_files(root)):
        num_bytes = file.stat().st_size
        digest.update(f"{file.relative_to(root).as_posix()}:{num_bytes};".encode())
        if file.suffix.lower() not in IMAGE_SUFFIXES and num_bytes <= _MAX_HASHED:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _visible_files(root: Path) -> Iterator[Path]:
    return (path for path in root.rglob("*") if path.is_file() and not path.name.startswith("."))
