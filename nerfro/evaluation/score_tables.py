"""Tables of one evaluation: each view in one region, and the means of all regions."""

from __future__ import annotations

from pathlib import Path

import rich

from nerfro.evaluation.results import FULL, METRICS, EvaluationResult, Region, write_metrics_json
from nerfro.evaluation.tables import MISSING, Column, Row, Table, to_rich, write_table


def views_table(result: EvaluationResult, title: str, region: Region = FULL) -> Table:
    """The scores of each view in one region, and their means below.

    Args:
        result: what an evaluation found.
        title: heading of the table.
        region: which part of the pictures.

    Returns:
        A row for each view, with a footnote for each metric that is missing.
    """
    rows = tuple(Row(view.name, tuple(view.score(m.name, region) for m in METRICS)) for view in result.views)
    mean = Row("mean", tuple(result.means_of(region).values()))
    return Table(title, "view", _columns(), rows, summary=(mean,), notes=tuple(_footnotes(result, region).values()))


def regions_table(result: EvaluationResult, title: str) -> Table:
    """The mean scores of each region, with footnotes for what is missing in one of them for another reason than in all.

    Args:
        result: what an evaluation found.
        title: heading of the table.
    """
    rows = tuple(Row(region, tuple(result.means_of(region).values())) for region in result.regions)
    told = _footnotes(result, FULL)
    notes = [
        f"{region}: {note}" if region != FULL and key != "mask" else note
        for region in result.regions
        for key, note in _footnotes(result, region).items()
        if region == FULL or told.get(key) != note
    ]
    return Table(title, "region", _columns(), rows, notes=tuple(dict.fromkeys(notes)))


def _columns() -> tuple[Column, ...]:
    return tuple(Column(metric.title, metric.better, metric.decimals) for metric in METRICS)


def _footnotes(result: EvaluationResult, region: Region) -> dict[str, str]:
    """Why something is missing in a region, by the metric's name, or `mask` for views that lack the region."""
    notes = {}
    if region != FULL and "mask" in result.notes:
        notes["mask"] = f"Mask and crop {MISSING}: {result.notes['mask']}"
    for metric in METRICS:
        key = metric.name if region == FULL else f"{region}.{metric.name}"
        if key in result.notes:
            notes[metric.name] = f"{metric.title} {MISSING}: {result.notes[key]}"
    return notes


def report(
    result: EvaluationResult,
    title: str,
    folder: Path,
    steps: int | None = None,
    seconds: float | None = None,
    rays_per_second: float | None = None,
) -> None:
    """Write metrics.json and the tables into a folder, and print the views' and the regions' table.

    Args:
        result: scores.
        title: of the table.
        folder: where the files go.
        steps, seconds, rays_per_second: of the training; None for pictures of another program.
    """
    write_metrics_json(folder / "metrics.json", result, steps, seconds, rays_per_second)
    for region in result.regions:
        full = region == FULL
        table = views_table(result, title if full else f"{title}, {region}", region)
        write_table(table, folder / ("metrics" if full else f"metrics_{region}"))
    rich.print(to_rich(views_table(result, title)))
    if len(result.regions) > 1:
        rich.print(to_rich(regions_table(result, "means of the full images, of the object's mask, and of the crop")))
