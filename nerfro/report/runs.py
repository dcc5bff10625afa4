"""Reader of run folders: configuration, training budget and scores of each run."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import NerfroError, first_of
from nerfro.core.paths import EMBEDDED_PREFIX, refuse_root, scene_name, shown, user_path
from nerfro.core.progress import duration
from nerfro.evaluation.results import RunMetrics, read_metrics_json
from nerfro.files.reading import open_image, read_foreign_config, read_json
from nerfro.registry.allowed import Count, check
from nerfro.training.config import check_trained
from nerfro.training.run_folder import CELL_FILE, LAST_CHECKPOINT

# Types of the values in run.json.
_FACTS: dict[str, Any] = {
    **dict.fromkeys(("command", "machine", "python"), str),
    **dict.fromkeys(("commit", "gpu"), (str, type(None))),
    "threads": int,
    "versions": dict,
    "algorithms": list,
}


@dataclass(frozen=True)
class Budget:
    """Training budget. Only runs with the same budget are compared.

    Attributes:
        seconds: limit of the wall-clock time in seconds, or None.
        steps: limit of the optimisation steps, or None.
        rays: rays per step, or None without a limit of steps.
        device: device, or None without a limit of time, because steps are comparable between devices.
    """

    seconds: float | None
    steps: int | None
    rays: int | None
    device: str | None

    @property
    def file_name(self) -> str:
        """Label as a file name without suffix."""
        return re.sub(r"\W+", "_", self.label.replace(",", "")).strip("_")

    @property
    def label(self) -> str:
        """Limits, such as "4 min on 1 CPU thread (x86_64)", "200,000 steps of 1,024 rays" or "unlimited"."""
        steps = "" if self.steps is None else f"{self.steps:,} steps of {self.rays:,} rays"
        if self.seconds is None:
            return steps or "unlimited"
        return f"{duration(self.seconds)} on {self.device}" + (f" and at most {steps}" if steps else "")

    @property
    def title(self) -> str:
        """Limits as the title of a table."""
        is_limited = self.seconds is not None or self.steps is not None
        return f"Budget: {'at most ' if is_limited else ''}{self.label}"


@dataclass(frozen=True)
class EvaluationSet:
    """Images that a run was scored on. Scores on different test sets are not comparable.

    Attributes:
        root: folder of the data set.
        split: split of the data set.
        num_views: number of scored images.
        width, height: size of the images in pixels.
        options: other options of the data format, except the bounds of rays.
    """

    root: str
    split: str
    num_views: int
    width: int
    height: int
    options: tuple[tuple[str, str], ...]

    @property
    def name(self) -> str:
        """Name of the scene: the last component of the folder."""
        return scene_name(self.root)


class IncompleteRunError(NerfroError):
    """A run that is omitted; the message is the reason."""


@dataclass(frozen=True)
class EvaluatedRun:
    """An evaluated run.

    Attributes:
        folder: run folder.
        scores: folder with metrics.json and images: the run folder, or an evaluation of the run.
        name: name of the experiment.
        seed: random seed.
        config: resolved configuration.
        facts: content of run.json: command, commit, versions and machine.
        metrics: scores, steps and training time.
        budget: training budget.
        test_set: images that were scored.
        evaluated_at: time of the evaluation, seconds since the epoch.
    """

    folder: Path
    scores: Path
    name: str
    seed: int
    config: Mapping[str, Any]
    facts: Mapping[str, Any]
    metrics: RunMetrics
    budget: Budget
    test_set: EvaluationSet
    evaluated_at: float


def find_runs(places: Sequence[str]) -> tuple[list[EvaluatedRun], list[str]]:
    """Read all evaluated runs below some folders.

    Args:
        places: run folders, folders that contain these at any depth, or glob patterns.

    Returns:
        Evaluated runs sorted by folder, and one line about each run that is omitted.

    Raises:
        NerfroError: a place does not exist, there is no evaluated run, or the files of a run are damaged.
    """
    folders: set[Path] = set()
    for place in places:
        path = user_path(place)
        refuse_root(path, "runs")
        exists = os.path.exists(path)  # its name may contain wildcards
        matches = [path] if exists else [Path(match) for match in glob.glob(str(path), recursive=True)]
        if not matches:
            raise NerfroError(
                f"runs: {place} does not exist; give run folders, folders that contain these, or glob patterns"
            )
        # A run of a sweep that failed early contains only the record of the failure.
        records = (file for match in matches for name in ("run.json", CELL_FILE) for file in match.rglob(name))
        folders |= {file.parent.resolve() for file in records}
    runs, unfinished = [], []
    for folder in sorted(folders):
        try:
            runs.append(read_run(folder))
        except IncompleteRunError as error:
            unfinished.append(f"{shown(folder)} is omitted: {error}")
    if not runs:
        reason = unfinished[0] if unfinished else "nerfro.train writes metrics.json beside run.json into a run folder"
        raise NerfroError(f"runs: no evaluated run below {', '.join(places)}; {reason}")
    return runs, unfinished


def _scores_folder(folder: Path) -> Path | None:
    """Return the folder with the scores of a run: those of nerfro.train, or those of nerfro.evaluate for test views."""
    places = (folder, folder / "evaluate_test")
    return next((place for place in places if (place / "metrics.json").is_file()), None)


def _why_unfinished(folder: Path) -> str:
    """Return the reason for a run without scores, if a sweep recorded it."""
    try:
        reason = read_json(folder / CELL_FILE, "")["reason"]
    except (NerfroError, KeyError, TypeError, IndexError):
        reason = ""
    if reason:
        return f"it failed: {reason}"
    command = f"; run {command_line('evaluate', as_overrides({'checkpoint': shown(folder)}))}"
    return f"it has not been evaluated{command if (folder / LAST_CHECKPOINT).is_file() else ''}"


def read_run(folder: Path) -> EvaluatedRun:
    """Read an evaluated run folder.

    Raises:
        IncompleteRunError: the run has no scores, or the first image is missing.
        NerfroError: a file is damaged.
    """
    scores = _scores_folder(folder)
    if scores is None:
        raise IncompleteRunError(_why_unfinished(folder))
    metrics = read_metrics_json(scores / "metrics.json")
    try:
        path = folder / "config.yaml"
        config: Any = OmegaConf.to_container(check_trained(read_foreign_config(path), path))
        facts = read_json(folder / "run.json", "repair it, or omit the run")
        wrong = [name for name, kind in _FACTS.items() if not isinstance(facts.get(name), kind)]
        if wrong:
            raise NerfroError(f"{folder / 'run.json'} has no valid {first_of(wrong)}; omit the run")
        check(f"{folder / 'run.json'}: ", {"threads": Count}, {"threads": facts["threads"]})
        data, trainer, root = config["data"], config["trainer"], str(config["data"]["root"])
        view = metrics.result.views[0].name
        file = scores / "images" / f"{view}.png"
        if not file.is_file():
            raise IncompleteRunError(f"its image {shown(file)} does not exist; restore it")
        with open_image(file) as (image, _):
            width, height = image.size
        options = sorted((key, str(value)) for key, value in data.items() if key not in ("root", "near", "far"))
        return EvaluatedRun(
            folder=folder,
            scores=scores,
            name=str(config["name"]),
            seed=int(config["seed"]),
            config=config,
            facts=facts,
            metrics=metrics,
            budget=_budget(trainer, int(config["batches"]["size"]), facts),
            test_set=EvaluationSet(
                root=root if root.startswith(EMBEDDED_PREFIX) else str(user_path(root).resolve()),
                split="test" if scores != folder else str(config["evaluation"]["split"]),
                num_views=len(metrics.result.views),
                width=width,
                height=height,
                options=tuple(options),
            ),
            evaluated_at=(scores / "metrics.json").stat().st_mtime,
        )
    except OSError as error:
        reason = f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
        raise NerfroError(f"the run {shown(folder)} cannot be read: {reason}; repair or omit it") from error
    except (OmegaConfBaseException, LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = str(error).strip().split("\n", 1)[0]
        raise NerfroError(
            f"the run {shown(folder)} is not in the format of nerfro.train ({type(error).__name__}: {reason}); omit it"
        ) from error


def device(config: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    """Return the training device, such as "NVIDIA H200" or "2 CPU threads (x86_64)"."""
    trainer = config["trainer"]
    if facts.get("gpu") and trainer["accelerator"] not in ("auto", "cpu"):
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
