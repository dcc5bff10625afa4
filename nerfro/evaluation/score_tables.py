"""Tables of one evaluation: each view in one region, and the means of all regions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import rich

from nerfro.evaluation.results import (
    AS_GIVEN,
    FULL,
    METRICS,
    EvaluationResult,
    Region,
    RunMetrics,
    Score,
    write_metrics_json,
)
from nerfro.evaluation.tables import MISSING, Column, Row, Table, to_rich, write_table

_Scores = Sequence[tuple[str, Mapping[str, Score]]]


def views_table(result: EvaluationResult, title: str, region: Region = FULL) -> Table:
    """The scores of each view in one region, their means below, and in one line why others are missing."""
    scores = [(view.name, {m.name: view.score(m.name, region) for m in METRICS}) for view in result.views]
    notes = [_mask_note(result) if region != FULL else "", _missing(result, region)]
    return _table(title, "view", scores, [("mean", result.means(region))], notes)


def regions_table(result: EvaluationResult, title: str) -> Table:
    """The mean scores of each region, to stand below `views_table`: what is missing in all of them was told there."""
    scores = [(region, result.means(region)) for region in result.regions]
    told = _missing(result, FULL)
    missing = {region: _missing(result, region) for region in result.regions}
    notes = [f"{region}: {note}" for region, note in missing.items() if note and note != told]
    return _table(title, "region", scores, [], [_mask_note(result), *notes])


def treatments_table(metrics: RunMetrics, title: str) -> Table:
    """The mean scores of the same views under each treatment."""
    treated = [(name, result.means()) for name, result in metrics.treatments.items()]
    return _table(title, "test views", [(AS_GIVEN, metrics.result.means()), *treated], [], [])


def short(reason: str) -> str:
    """A reason without the remedy behind its semicolon, which `metrics.json` keeps."""
    return reason.partition(";")[0]


def _table(title: str, label: str, rows: _Scores, summary: _Scores, notes: Sequence[str]) -> Table:
    """A table of the metrics that any row has; of all where none has one."""
    kept = [m for m in METRICS if any(scores[m.name] is not None for _, scores in rows)] or list(METRICS)
    body, foot = (
        tuple(Row(name, tuple(scores[metric.name] for metric in kept)) for name, scores in part)
        for part in (rows, summary)
    )
    columns = tuple(Column(metric.title, metric.better, metric.decimals) for metric in kept)
    return Table(title, label, columns, body, summary=foot, notes=tuple(note for note in notes if note))


def _mask_note(result: EvaluationResult) -> str:
    """Why views lack both regions of the object."""
    return f"Mask and crop {MISSING}: {result.notes['mask']}" if "mask" in result.notes else ""


def _missing(result: EvaluationResult, region: Region) -> str:
    """In one line, which metrics are missing in a region and why."""
    by_reason: dict[str, list[str]] = {}
    for metric in METRICS:
        reason = result.notes.get(metric.name if region == FULL else f"{region}.{metric.name}")
        if reason is not None:
            by_reason.setdefault(short(reason), []).append(metric.title)
    told = ", ".join(f"{', '.join(titles)} ({reason})" for reason, titles in by_reason.items())
    return f"{MISSING}: {told}" if told else ""


def report(metrics: RunMetrics, title: str, folder: Path) -> None:
    """Write metrics.json and the tables into a folder, and print the views' and the regions' table."""
    write_metrics_json(folder / "metrics.json", metrics)
    result = metrics.result
    for region in result.regions:
        full = region == FULL
        table = views_table(result, title if full else f"{title}, {region}", region)
        write_table(table, folder / ("metrics" if full else f"metrics_{region}"))
    rich.print(to_rich(views_table(result, title)))
    if len(result.regions) > 1:
        rich.print(to_rich(regions_table(result, "means of the full images, of the object's mask, and of the crop")))
    if metrics.treatments:
        rich.print(to_rich(treatments_table(metrics, "means of the full images, or of right halves")))
