"""Runs that can be compared, and their table: methods as rows, scenes and metrics as columns, over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from nerfro.errors import NerfroError
from nerfro.evaluation.results import FULL, METRICS, Metric, Region
from nerfro.evaluation.tables import MISSING, Column, Row, Table, short
from nerfro.report.runs import Budget, Run, Scored, shown
from nerfro.training.settings import TABLE_ROW, settings


@dataclass(frozen=True)
class Comparison:
    """All runs of one budget."""

    budget: Budget  # what each was allowed to spend
    methods: tuple[str, ...]  # titles of the methods, in the order of the table
    scenes: Mapping[Scored, str]  # what was scored, in the order of the table, with titles
    cells: Mapping[tuple[str, Scored], tuple[Run, ...]]  # of a method on a scene, one for each seed, by seed
    notes: tuple[str, ...]  # what a reader has to know

    @property
    def runs(self) -> list[Run]:
        return [run for method in self.methods for scene in self.scenes for run in self.cells.get((method, scene), ())]


def compare(runs: Sequence[Run], methods: Mapping[str, str], scenes: Mapping[str, str]) -> list[Comparison]:
    """Sort runs into comparisons, one for each budget; `methods` and `scenes` are titles, in their order.

    Runs of one experiment whose configurations differ in more than the seed are different methods, and are told apart
    by the fields that differ. What has no title follows under its own name.
    """
    budgets = sorted({run.budget for run in runs}, key=lambda b: (b.seconds or 0, b.steps or 0, b.label))
    return [_comparison(budget, [r for r in runs if r.budget == budget], methods, scenes) for budget in budgets]


def to_table(comparison: Comparison, metrics: Sequence[Metric], region: Region) -> Table:
    """The scores of a comparison, means and standard deviations over seeds, the best three marked."""
    columns = [
        Column(metric.title, metric.better, metric.decimals, group=title)
        for title in comparison.scenes.values()
        for metric in metrics
    ]
    rows, notes = [], list(comparison.notes)
    for method in comparison.methods:
        cells = [
            _score(comparison.cells.get((method, scene), ()), metric.name, region)
            for scene in comparison.scenes
            for metric in metrics
        ]
        rows.append(Row(method, tuple(mean for mean, _ in cells), tuple(spread for _, spread in cells)))
    notes += dict.fromkeys(
        f"{metric.title} {MISSING}: {short(reason)}"
        for run in comparison.runs
        for metric in metrics
        if (reason := _reason(run, metric.name, region))
    )
    title = "; ".join(
        [f"Trained for {comparison.budget.label}", *_what_was_scored(comparison, region), _seeds(comparison)]
    )
    mark: Literal["", "medals"] = "medals" if len(rows) > 1 else ""
    return Table(title, "method", tuple(columns), tuple(rows), mark=mark, notes=tuple(notes))


def find_metrics(names: Sequence[str]) -> list[Metric]:
    """The metrics of these names, at least one; a name that is none is refused."""
    known = {metric.name: metric for metric in METRICS}
    if not names:
        raise NerfroError(f"metrics: none is given; choose from {', '.join(known)}")
    for name in names:
        if name not in known:
            raise NerfroError(f"metrics: '{name}' is not a metric; choose from {', '.join(known)}")
    return [known[name] for name in names]


def _comparison(
    budget: Budget, runs: Sequence[Run], methods: Mapping[str, str], scenes: Mapping[str, str]
) -> Comparison:
    titles = _method_titles(runs, methods)
    names = {titles[run.folder]: run.name for run in runs}
    cells: dict[tuple[str, Scored], tuple[Run, ...]] = {}
    notes = []
    for run in sorted(runs, key=lambda r: (r.seed, -r.evaluated_at)):
        place = titles[run.folder], run.scored
        others = cells.get(place, ())
        newer = next((other for other in others if other.seed == run.seed), None)
        if newer is None:
            cells[place] = (*others, run)
        else:
            notes.append(f"{shown(run.folder)} is left out: {shown(newer.folder)} repeats it, and is newer")
    commits = sorted({str(run.facts.get("commit"))[:7] for run in runs})
    if len(commits) > 1:
        notes.append(f"The runs are of different versions of the code: {', '.join(commits)}")
    return Comparison(
        budget,
        tuple(sorted(names, key=lambda title: (*_rank(names[title], methods), title))),
        _scene_titles({run.scored for run in runs}, scenes),
        cells,
        tuple(notes),
    )


def _rank(name: str, order: Mapping[str, str]) -> tuple[int, str]:
    return (list(order).index(name), name) if name in order else (len(order), name)


def _method_titles(runs: Sequence[Run], titles: Mapping[str, str]) -> dict[Any, str]:
    """Title of each run's method, by folder: its experiment's, with the fields in which its runs on a scene differ."""
    named: dict[Any, str] = {}
    for name in {run.name for run in runs}:
        configs = {run.folder: _method(run) for run in runs if run.name == name}
        fields: set[str] = set()
        for scene in {run.scored for run in runs}:
            fields |= differing([configs[run.folder] for run in runs if run.name == name and run.scored == scene])
        for folder, config in configs.items():
            said = [field for field in sorted(fields) if field in config]
            values = [f"{field.removesuffix('._target_')}={_value(config[field])}" for field in said]
            named[folder] = titles.get(name, name) + (f" ({', '.join(values)})" if values else "")
    return named


def _method(run: Run) -> dict[str, Any]:
    """The fields of a configuration that make its method, with what lies in the data's folder named relative to it."""
    root = str(run.config["data"]["root"])
    fields = settings(run.config, TABLE_ROW)
    return {k: v.replace(root, "${data.root}") if isinstance(v, str) else v for k, v in fields.items()}


def differing(configs: Sequence[Mapping[str, Any]]) -> set[str]:
    """The fields whose values differ; those of a part only where the part is of the same class."""
    fields = set()
    for key in {key for config in configs for key in config}:
        part = f"{key.rpartition('.')[0]}._target_"
        values: dict[str, set[str]] = {}
        for config in configs:
            kind = "" if key == part else str(config.get(part))
            values.setdefault(kind, set()).add(repr(config.get(key)))
        if any(len(found) > 1 for found in values.values()):
            fields.add(key)
    return fields


def _value(value: object) -> str:
    return value.rpartition(".")[2] if isinstance(value, str) and value.startswith("nerfro") else str(value)


def _scene_titles(scored: set[Scored], titles: Mapping[str, str]) -> dict[Scored, str]:
    """Titles of scenes in their order, each with that in which it differs from others of its name, or of all."""
    ordered = sorted(scored, key=lambda s: (*_rank(s.name, titles), s.root, s.width * s.height, _parts(s)))
    named = {}
    for scene in ordered:
        namesakes = [other for other in ordered if other.name == scene.name]
        extra = [part for part in _parts(scene) if part and any(part not in _parts(other) for other in ordered)]
        if len({other.root for other in namesakes}) > 1:
            extra.append(scene.root)
        extra += [f"{k}={v}" for k, v in scene.reading if len({dict(o.reading).get(k) for o in namesakes}) > 1]
        named[scene] = ", ".join([titles.get(scene.name, scene.name), *extra])
    return named


def _parts(scored: Scored) -> tuple[str, str, str]:
    """What the pictures are, in words; the last is empty for what is usual."""
    views = f"{scored.num_views} {scored.split} view{'s' if scored.num_views != 1 else ''}"
    return (
        views,
        f"{scored.width} x {scored.height} pixels",
        "" if scored.protocol == "8bit" else "not rounded to 8 bits",
    )


def _what_was_scored(comparison: Comparison, region: Region) -> list[str]:
    """What is the same of all scenes; what differs stands in their titles."""
    parts = [set(texts) for texts in zip(*map(_parts, comparison.scenes), strict=True)]
    common = [text for texts in parts if len(texts) == 1 for text in texts if text]
    return common + ([f"scores of the {region}"] if region != FULL else [])


def _seeds(comparison: Comparison) -> str:
    """How many runs stand behind the numbers."""
    counts = {place: len(runs) for place, runs in comparison.cells.items()}
    if set(counts.values()) == {1}:
        return "one run each"
    if len(set(counts.values())) == 1:
        return f"mean ± standard deviation over {next(iter(counts.values()))} seeds"
    several = [
        f"{method} on {comparison.scenes[scene]} {number}" for (method, scene), number in counts.items() if number > 1
    ]
    return f"mean ± standard deviation over seeds: {', '.join(several)}; one run elsewhere"


def _score(runs: Sequence[Run], metric: str, region: Region) -> tuple[float | None, float | None]:
    """Mean and sample standard deviation over runs; None where a run has no value, or where there is one run."""
    values = [run.metrics.result.mean(metric, region) for run in runs]
    present = [value for value in values if value is not None]
    if not present or len(present) < len(values):
        return None, None
    return statistics.fmean(present), statistics.stdev(present) if len(present) > 1 else None


def _reason(run: Run, metric: str, region: Region) -> str | None:
    """Why a run has no value of a metric."""
    if run.metrics.result.mean(metric, region) is not None:
        return None
    notes = run.metrics.result.notes
    keys = (metric,) if region == FULL else (f"{region}.{metric}", "mask")
    return next((notes[key] for key in keys if key in notes), f"not among the scores of {shown(run.folder)}")
