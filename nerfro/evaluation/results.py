"""Scores of an evaluation, per view and averaged, and the file `metrics.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Lt

from nerfro.core.errors import NerfroError
from nerfro.evaluation.image_metrics import image_metrics
from nerfro.files.atomic import write_atomically
from nerfro.files.reading import is_number, read_json
from nerfro.registry.allowed import check

TOO_LARGE = 1e15  # for scores, steps and times; sums of larger numbers may overflow
_Amount = Annotated[float, Ge(0), Lt(TOO_LARGE)]
Score = float | None  # None if not available; the notes contain the reason


Region = Literal["full", "mask", "crop"]  # see nerfro/evaluation/image_metrics.py
FULL: Region = "full"
OBJECT: Region = "mask"
# Scores with the given cameras and exposure, of tone-mapped images, and of right halves without and with exposures that
# are fitted to the left halves; docs/reference/metrics.md.
AS_GIVEN, TONE_MAPPED, UNEXPOSED, EXPOSED = "as given", "tone_mapped", "unexposed", "exposed"
OF_HALVES = UNEXPOSED, EXPOSED
OBJECT_REGIONS: tuple[Region, ...] = (OBJECT, "crop")  # regions that require a mask of the object


@dataclass(frozen=True)
class ViewScores:
    """Scores of one view.

    Attributes:
        name: name of the view; `images/<name>.png` is its image.
        scores: scores of the full image by metric.
        regions: scores of the object's mask and of the crop around it, by metric; empty without a mask.
    """

    name: str
    scores: Mapping[str, Score]
    regions: Mapping[Region, Mapping[str, Score]] = field(default_factory=dict)

    def score(self, metric: str, region: Region = FULL) -> Score:
        """Return the score of a metric in a region, or None if it is not available."""
        scores = self.scores if region == FULL else self.regions.get(region, {})
        return scores.get(metric)


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of all views.

    Attributes:
        views: scores of each view, in order.
        notes: reasons for missing scores by metric, and under `mask` for views without both object regions.
    """

    views: tuple[ViewScores, ...]
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def regions(self) -> tuple[Region, ...]:
        """Scored regions, the full image first."""
        return (FULL, *(region for region in OBJECT_REGIONS if any(region in view.regions for view in self.views)))

    def mean(self, metric: str, region: Region = FULL) -> Score:
        """Average a score over all views; None if any view lacks it, because means over different views differ."""
        values = [view.score(metric, region) for view in self.views]
        present = [value for value in values if value is not None]
        return math.fsum(present) / len(present) if present and len(present) == len(values) else None

    def means(self, region: Region = FULL) -> dict[str, Score]:
        """Return the mean of every metric in a region, by name."""
        return {name: self.mean(name, region) for name in image_metrics()}


def optimized(result: EvaluationResult, name: str) -> float:
    """Return the mean score that a sweep optimizes.

    Args:
        result: scores of all views.
        name: a metric, or `<region>.<metric>`, such as `mask.psnr`.

    Raises:
        NerfroError: there is no such score.
    """
    scores = {f"{region}.{metric}": mean for region in result.regions for metric, mean in result.means(region).items()}
    score = scores.get(name if "." in name else f"{FULL}.{name}")
    if score is None:
        names = ", ".join(key.removeprefix(f"{FULL}.") for key, mean in scores.items() if mean is not None)
        raise NerfroError(f"optimized_metric={name} was not scored; choose one of {names}")
    return score


@dataclass(frozen=True)
class RunMetrics:
    """Content of the file `metrics.json` of a run.

    Attributes:
        result: scores of the test views.
        steps: number of optimizer steps; None for images of another program.
        train_seconds: wall-clock time of training in seconds, without evaluation; None without training.
        rays_per_second: training throughput; None without training.
        treatments: scores of the same views with corrected cameras or exposures, or another tone curve; see
            `nerfro.evaluation.scoring`.
        steps_by_phase: number of steps of each phase of the training, such as `background` and `scene`.
    """

    result: EvaluationResult
    steps: int | None = None
    train_seconds: float | None = None
    rays_per_second: float | None = None
    treatments: Mapping[str, EvaluationResult] = field(default_factory=dict)
    steps_by_phase: Mapping[str, int] = field(default_factory=dict)


def write_metrics_json(path: Path | str, metrics: RunMetrics) -> None:
    """Write `metrics.json` atomically; docs/reference/file_formats.md describes the format.

    Raises:
        NerfroError: a number is NaN or infinite, which JSON cannot represent, or the file cannot be written.
    """
    result = metrics.result
    content = {
        **_scored(result),
        "test_views": AS_GIVEN,
        "treatments": {name: _scored(treated) for name, treated in metrics.treatments.items()},
        "steps": metrics.steps,
        "steps_by_phase": dict(metrics.steps_by_phase),
        "train_seconds": metrics.train_seconds,
        "rays_per_second": metrics.rays_per_second,
        "notes": dict(result.notes),
    }
    try:
        text = json.dumps(content, indent=2, allow_nan=False)
    except ValueError as error:
        raise NerfroError(f"{path}: a score is NaN or infinite, which JSON cannot represent ({error})") from error
    write_atomically(path, text + "\n")


def read_metrics_json(path: Path | str) -> RunMetrics:
    """Read a file of `write_metrics_json`. Means are computed again; metrics and regions may be missing.

    Raises:
        NerfroError: the file is missing, truncated, or lacks a key.
    """
    path = Path(path)
    if not path.is_file():
        raise NerfroError(f"{path} does not exist; run nerfro.evaluate to create it")
    try:
        content = read_json(path, "run nerfro.evaluate on the run again")
        notes = content.get("notes", {})
        if not all(isinstance(note, str) for note in notes.values()):
            raise TypeError("its notes are damaged")
        result = EvaluationResult(_views(content["views"]), notes)
        treatments = {
            name: EvaluationResult(_views(treated["views"]), notes)
            for name, treated in content.get("treatments", {}).items()
        }
        amounts = {key: content[key] for key in ("steps", "train_seconds", "rays_per_second")}
        phases = {str(phase): count for phase, count in content.get("steps_by_phase", {}).items()}
        for values in (amounts, phases):
            check(f"{path}: ", dict.fromkeys(values, _Amount), values)
        return RunMetrics(result, **amounts, treatments=treatments, steps_by_phase=phases)
    except (KeyError, TypeError, AttributeError) as error:
        raise NerfroError(f"{path} is not a metrics file ({error!r}); run nerfro.evaluate on the run again") from error


def _scored(result: EvaluationResult) -> dict[str, Any]:
    return {
        "test": result.means(),
        "regions": {region: result.means(region) for region in result.regions if region != FULL},
        "views": [
            {"name": view.name, **view.scores, "regions": {name: dict(row) for name, row in view.regions.items()}}
            for view in result.views
        ],
    }


def _views(rows: list[Any]) -> tuple[ViewScores, ...]:
    return tuple(
        ViewScores(
            str(row["name"]),
            _scores(row),
            {r: _scores(s) for r, s in row.get("regions", {}).items() if r in OBJECT_REGIONS},
        )
        for row in rows
    )


def _scores(row: Mapping[str, Any]) -> dict[str, Score]:
    return {name: _number(row.get(name)) for name in image_metrics()}


def _number(value: object) -> float | None:
    if value is None or (is_number(value) and abs(value) < TOO_LARGE):
        return value
    raise TypeError(f"{str(value)[:20]} is not a number below {TOO_LARGE:g}")
