"""What an evaluation found: scores of each view, their means, and the file `metrics.json` that holds them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nerfro.data.transforms import is_number, read_json
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically

Score = float | None  # None: not available, the reason stands in the notes


@dataclass(frozen=True)
class Metric:
    """How a metric is called and read."""

    name: str  # key in files and in code
    title: str  # heading in tables
    better: Literal["higher", "lower"]  # whether higher or lower values are better
    decimals: int  # digits after the point in tables


METRICS = (
    Metric("psnr", "PSNR", "higher", 2),
    Metric("ssim", "SSIM", "higher", 3),
    Metric("ms_ssim", "MS-SSIM", "higher", 3),
    Metric("lpips", "LPIPS", "lower", 3),
    Metric("lpips_vgg", "LPIPS-VGG", "lower", 3),
    Metric("flip", "FLIP", "lower", 3),
)

Region = Literal["full", "mask", "crop"]  # of a picture, see nerfro/evaluation/regions.py
FULL: Region = "full"
AS_GIVEN = "as given"  # how test views are treated under `test`: cameras and exposure are the data's
OBJECT_REGIONS: tuple[Region, ...] = ("mask", "crop")  # those that need to know where the object is


@dataclass(frozen=True)
class ViewScores:
    """The scores of one picture."""

    name: str  # which view it is; `images/<name>.png` is the picture
    scores: Mapping[str, Score]  # value of each metric on the full image, by name; None where it is not available
    # The same on the object's mask and on the crop around it; empty where there is no mask.
    regions: Mapping[Region, Mapping[str, Score]] = field(default_factory=dict)

    def score(self, metric: str, region: Region = FULL) -> Score:
        """The value of one metric in one region; None where it is not available."""
        scores = self.scores if region == FULL else self.regions.get(region, {})
        return scores.get(metric)


@dataclass(frozen=True)
class EvaluationResult:
    """The scores of all views."""

    views: tuple[ViewScores, ...]  # one row for each view, in order
    # Why a metric is not available: by its name for the full image, by `<region>.<metric>` in a region, and by `mask`
    # for views in which both regions are missing.
    notes: Mapping[str, str] = field(default_factory=dict)
    protocol: Literal["8bit", "float"] = "8bit"  # whether predictions were rounded to what a PNG holds before scoring

    @property
    def regions(self) -> tuple[Region, ...]:
        """The regions that were scored, the full image first."""
        return (FULL, *(region for region in OBJECT_REGIONS if any(region in view.regions for view in self.views)))

    def mean(self, metric: str, region: Region = FULL) -> Score:
        """Mean of the per-view values; None if any view lacks one, for a mean over fewer views is another quantity."""
        values = [view.score(metric, region) for view in self.views]
        present = [value for value in values if value is not None]
        return math.fsum(present) / len(present) if present and len(present) == len(values) else None

    def means(self, region: Region = FULL) -> dict[str, Score]:
        """The mean of every metric in a region, by name."""
        return {metric.name: self.mean(metric.name, region) for metric in METRICS}


@dataclass(frozen=True)
class RunMetrics:
    """The content of a run's `metrics.json`."""

    result: EvaluationResult  # scores of the test views
    steps: int | None = None  # optimisation steps that the weights have seen; None for pictures of another program
    train_seconds: float | None = None  # wall-clock, without evaluation; None if nothing was trained
    rays_per_second: float | None = None  # training throughput; None if nothing was trained
    # The same views under other cameras or exposures than the data's, by the name of the treatment; see `treatments`.
    treatments: Mapping[str, EvaluationResult] = field(default_factory=dict)


def write_metrics_json(path: Path | str, metrics: RunMetrics) -> None:
    """Write the file by which other tools read a run, whole or not at all; docs/metrics.md says what it holds.

    Raises:
        NerfroError: if a number is NaN or infinite (JSON has neither), or the file cannot be written.
    """
    result = metrics.result
    content = {
        **_scored(result),
        "test_views": AS_GIVEN,
        "treatments": {name: _scored(treated) for name, treated in metrics.treatments.items()},
        "steps": metrics.steps,
        "train_seconds": metrics.train_seconds,
        "rays_per_second": metrics.rays_per_second,
        "notes": dict(result.notes),
        "protocol": result.protocol,
    }
    _refuse_non_finite(content, "metrics")
    write_atomically(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_metrics_json(path: Path | str) -> RunMetrics:
    """Read what `write_metrics_json` wrote, now or when it knew fewer metrics and no regions; means are computed again.

    Raises:
        NerfroError: if the file is missing, truncated, or lacks a key.
    """
    path = Path(path)
    if not path.is_file():
        raise NerfroError(f"{path} does not exist; has this run been evaluated? run nerfro.evaluate on it")
    try:
        content = read_json(path, "run nerfro.evaluate on the run again")
        notes, protocol = content.get("notes", {}), content.get("protocol", "8bit")
        result = EvaluationResult(_views(content["views"]), notes, protocol)
        treatments = {
            name: EvaluationResult(_views(treated["views"]), notes, protocol)
            for name, treated in content.get("treatments", {}).items()
        }
        spent = {key: _number(content[key]) for key in ("steps", "train_seconds", "rays_per_second")}
        return RunMetrics(result, **spent, treatments=treatments)  # type: ignore[arg-type]
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


def _scores(row: Mapping[str, Score]) -> dict[str, Score]:
    return {metric.name: _number(row.get(metric.name)) for metric in METRICS}


def _number(value: object) -> float | None:
    if value is None or is_number(value):
        return value
    raise TypeError(f"{value!r} is no number")


def _refuse_non_finite(value: object, name: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise NerfroError(f"{name} is {value}, which JSON cannot hold; give a finite number, or None if there is none")
    if isinstance(value, dict):
        for key, item in value.items():
            _refuse_non_finite(item, f"{name}.{key}")
    if isinstance(value, list):
        for index, item in enumerate(value):
            _refuse_non_finite(item, f"{name}[{index}]")
