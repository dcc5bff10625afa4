"""Run folders as other tools see them: what was trained at which cost, and what it scored."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from PIL import Image

from nerfro.data.transforms import read_json
from nerfro.errors import NerfroError, first_of
from nerfro.evaluation.results import RunMetrics, read_metrics_json
from nerfro.files.foreign_config import foreign_config
from nerfro.paths import EMBEDDED_PREFIX, user_path
from nerfro.training.run_folder import CELL_FILE
from nerfro.training.sweeps import scene_name

_FACTS = {"command", "machine", "python", "threads", "versions"}  # of run.json


@dataclass(frozen=True)
class Budget:
    """What a training was allowed to spend; only runs of one budget can be compared."""

    seconds: float | None  # wall-clock time, None if it was not limited
    steps: int | None  # optimisation steps, None if they were not limited
    rays: int | None  # of a step; None if only the time was limited
    device: str | None  # on which the time was spent; None if only steps were limited: they cost the same everywhere

    @property
    def file_name(self) -> str:
        """The label as a file name, without suffix."""
        return re.sub(r"\W+", "_", self.label.replace(",", "")).strip("_")

    @property
    def label(self) -> str:
        """As in "4 min on 1 CPU thread (x86_64)" or "200,000 steps of 1,024 rays"."""
        steps = "" if self.steps is None else f"{self.steps:,} steps of {self.rays:,} rays"
        if self.seconds is None:
            return steps
        return f"{duration(self.seconds)} on {self.device}" + (f", at most {steps}" if steps else "")


@dataclass(frozen=True)
class Scored:
    """What a run was scored on; scores of different ones are different quantities."""

    root: str  # folder of the data
    split: str  # of the data
    num_views: int  # pictures that were scored
    width: int  # of the pictures, in pixels
    height: int
    protocol: str  # "8bit" or "float", see `EvaluationResult`
    reading: tuple[tuple[str, str], ...]  # options of the data source, apart from the folder and the range of its rays

    @property
    def name(self) -> str:
        """Last part of the folder's name."""
        return scene_name(self.root)


@dataclass(frozen=True)
class Run:
    """An evaluated run."""

    folder: Path  # where it lies
    name: str  # of its experiment
    seed: int  # of its random draws
    config: Mapping[str, Any]  # its resolved configuration
    facts: Mapping[str, Any]  # its run.json: command, commit, versions and machine
    metrics: RunMetrics  # scores and what was spent
    budget: Budget  # what it was allowed to spend
    scored: Scored  # what it was scored on
    evaluated_at: float  # when its scores were written, seconds since the epoch


def find_runs(places: Sequence[str]) -> tuple[list[Run], list[str]]:
    """Read all evaluated runs below some folders, by folder, and say in a line why each other run is left out.

    Raises:
        NerfroError: a place does not exist, none holds an evaluated run, or a run's files are damaged.
    """
    folders: set[Path] = set()
    for place in places:
        matches = [Path(match) for match in glob.glob(str(user_path(place)), recursive=True)]
        if not matches:
            raise NerfroError(f"runs: {place} does not exist; give run folders, folders that hold some, or globs")
        # A cell of a sweep that failed early has nothing but the record of its failure.
        found = (file for match in matches for name in ("run.json", CELL_FILE) for file in match.rglob(name))
        folders |= {file.parent.resolve() for file in found}
    runs, unfinished = [], []
    for folder in sorted(folders):
        if (folder / "metrics.json").is_file():
            runs.append(read_run(folder))
        else:
            unfinished.append(f"{shown(folder)} is left out: {_why_unfinished(folder)}")
    if not runs:
        reason = f"; {unfinished[0]}" if unfinished else "; nerfro.train writes one into every run folder"
        raise NerfroError(f"runs: no metrics.json beside a run.json below {', '.join(places)}{reason}")
    return runs, unfinished


def _why_unfinished(folder: Path) -> str:
    """The reason that a sweep recorded for a run without scores, if one did."""
    try:
        reason = json.loads((folder / CELL_FILE).read_text(encoding="utf-8"))["reason"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        reason = ""
    return f"it failed: {reason}" if reason else "it has no metrics.json, so it has not been evaluated"


def read_run(folder: Path) -> Run:
    """Read an evaluated run folder."""
    metrics = read_metrics_json(folder / "metrics.json")
    try:
        text = (folder / "config.yaml").read_text(encoding="utf-8")
        config: Any = OmegaConf.to_container(foreign_config(text, folder / "config.yaml"))
        facts = read_json(folder / "run.json", "repair it or leave the run out")
        absent = _FACTS - facts.keys()
        if absent:
            raise NerfroError(f"{folder / 'run.json'} lacks {first_of(sorted(absent))}; leave the run out")
        data, trainer, root = config["data"], config["trainer"], str(config["data"]["root"])
        view = metrics.result.views[0].name
        with Image.open(folder / "images" / f"{view}.png") as image:
            width, height = image.size
        reading = sorted((key, str(value)) for key, value in data.items() if key not in ("root", "near", "far"))
        return Run(
            folder=folder,
            name=str(config["name"]),
            seed=int(config["seed"]),
            config=config,
            facts=facts,
            metrics=metrics,
            budget=_budget(trainer, int(config["batches"]["size"]), facts),
            scored=Scored(
                root=root if root.startswith(EMBEDDED_PREFIX) else str(user_path(root).resolve()),
                split=str(config["evaluation"]["split"]),
                num_views=len(metrics.result.views),
                width=width,
                height=height,
                protocol=metrics.result.protocol,
                reading=tuple(reading),
            ),
            evaluated_at=(folder / "metrics.json").stat().st_mtime,
        )
    except OSError as error:
        reason = f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
        raise NerfroError(f"the run {shown(folder)} cannot be read: {reason}; repair it or leave it out") from error
    except (OmegaConfBaseException, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        reason = str(error).strip().split("\n", 1)[0]
        raise NerfroError(
            f"the run {shown(folder)} is not as nerfro.train writes it ({type(error).__name__}: {reason}); leave it out"
        ) from error


def duration(seconds: float) -> str:
    """As in "1 h 30 min", "4 min" or "20 s"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [f"{number} {unit}" for number, unit in ((hours, "h"), (minutes, "min"), (rest, "s")) if number]
    return " ".join(parts) or "0 s"


def shown(folder: Path) -> str:
    """A folder as the user would type it: relative to the current one where it lies below it."""
    return str(folder.relative_to(Path.cwd())) if folder.is_relative_to(Path.cwd()) else str(folder)


def device(config: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    """What a run was trained on, as in "NVIDIA H200" or "2 CPU threads (x86_64)"."""
    trainer = config["trainer"]
    if facts.get("gpu") and trainer["accelerator"] != "cpu":
        number = trainer["devices"]
        return facts["gpu"] if number == 1 else f"{number} x {facts['gpu']}"
    threads = facts["threads"]
    return f"{threads} CPU thread{'s' if threads != 1 else ''} ({facts['machine']})"


def _budget(trainer: Mapping[str, Any], rays: int, facts: Mapping[str, Any]) -> Budget:
    limit, steps = trainer.get("max_time"), trainer.get("max_steps", -1)
    seconds = None
    if isinstance(limit, str):  # DD:HH:MM:SS
        days, hours, minutes, rest = map(float, limit.split(":"))
        seconds = timedelta(days=days, hours=hours, minutes=minutes, seconds=rest).total_seconds()
    elif limit is not None:
        seconds = timedelta(**limit).total_seconds()
    limited = steps is not None and steps >= 0
    where = None if seconds is None else device({"trainer": trainer}, facts)
    return Budget(seconds, steps if limited else None, rays if limited else None, where)
