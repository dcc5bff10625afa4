"""Comparison of runs: a table with methods as rows and scenes and metrics as columns, averaged over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerfro.core.paths import shown
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.evaluation.results import FULL, OBJECT, Region
from nerfro.evaluation.tables import MISSING, Column, Row, Table, short
from nerfro.report.runs import Budget, EvaluatedRun, EvaluationSet
from nerfro.training.settings import TABLE_ROW, settings


@dataclass(frozen=True)
class Comparison:
    """All runs with the same budget.

    Attributes:
        budget: training budget of each run.
        methods: titles of the methods, in the order of the table.
        scenes: titles of the test sets, in the order of the table.
        cells: runs of a method on a test set, one per seed, sorted by seed.
        notes: footnotes of the table.
    """

    budget: Budget
    methods: tuple[str, ...]
    scenes: Mapping[EvaluationSet, str]
    cells: Mapping[tuple[str, EvaluationSet], tuple[EvaluatedRun, ...]]
    notes: tuple[str, ...]

    @property
    def runs(self) -> list[EvaluatedRun]:
        return [run for method in self.methods for scene in self.scenes for run in self.cells.get((method, scene), ())]


def compare(runs: Sequence[EvaluatedRun], methods: Mapping[str, str], scenes: Mapping[str, str]) -> list[Comparison]:
    """Group runs by budget, method and test set.

    Runs of one experiment whose configurations differ in more than the seed are different methods; the title of each
    method lists the fields that differ.

    Args:
        runs: evaluated runs.
        methods: titles of experiments, in the order of the table. Other experiments follow under their names.
        scenes: titles of scenes, in the order of the table. Other scenes follow under their names.

    Returns:
        One comparison per budget.
    """
    budgets = sorted({run.budget for run in runs}, key=lambda b: (b.seconds or 0, b.steps or 0, b.label))
    return [_comparison(budget, [r for r in runs if r.budget == budget], methods, scenes) for budget in budgets]


def to_table(comparison: Comparison, metrics: Mapping[str, type[ImageMetric]], region: Region) -> Table:
    """Tabulate means and standard deviations over seeds, without empty columns; medals mark the best three methods.

    In a table of full images, the first metric is also tabulated for the object.
    """
    scores = [(name, region) for name in metrics]
    if region == FULL:
        scores.insert(1, (scores[0][0], OBJECT))
    columns = [
        Column(metric.title if part == region else f"{metric.title} object", metric.better, metric.decimals, scene)
        for scene in comparison.scenes.values()
        for metric, part in ((metrics[name], part) for name, part in scores)
    ]
    rows, notes = [], list(comparison.notes)
    for method in comparison.methods:
        cells = [
            _score(comparison.cells.get((method, scene), ()), name, part)
            for scene in comparison.scenes
            for name, part in scores
        ]
        rows.append(Row(method, tuple(mean for mean, _ in cells), tuple(spread for _, spread in cells)))
    notes += dict.fromkeys(
        f"{metric.title} {MISSING}: {short(reason)}"
        for run in comparison.runs
        for name, metric in metrics.items()
        # Most data have no maps.
        if not metric.maps or any(other.metrics.result.mean(name) is not None for other in comparison.runs)
        if (reason := _reason(run, name, region))
    )
    descriptions = [*_common_description(comparison, region), _describe_seeds(comparison)]
    title = "; ".join([comparison.budget.title, *descriptions])
    table = Table(title, "method", tuple(columns), tuple(rows), medals=len(rows) > 1, notes=tuple(notes))
    return table.without_empty_columns()


def _comparison(
    budget: Budget, runs: Sequence[EvaluatedRun], methods: Mapping[str, str], scenes: Mapping[str, str]
) -> Comparison:
    titles = _method_titles(runs, methods)
    names = {titles[run.folder]: run.name for run in runs}
    cells: dict[tuple[str, EvaluationSet], tuple[EvaluatedRun, ...]] = {}
    notes = []
    for run in sorted(runs, key=lambda r: (r.seed, -r.evaluated_at)):
        cell = titles[run.folder], run.test_set
        others = cells.get(cell, ())
        newer = next((other for other in others if other.seed == run.seed), None)
        if newer is None:
            cells[cell] = (*others, run)
        else:
            notes.append(f"{shown(run.folder)} is omitted: {shown(newer.folder)} is a newer run with the same seed")
    commits = sorted({str(run.facts.get("commit"))[:7] for run in runs})
    if len(commits) > 1:
        notes.append(f"The runs used different versions of the code: {', '.join(commits)}")
    return Comparison(
        budget,
        tuple(sorted(names, key=lambda title: (*_rank(names[title], methods), title))),
        _scene_titles({run.test_set for run in runs}, scenes),
        cells,
        tuple(notes),
    )


def _rank(name: str, order: Mapping[str, str]) -> tuple[int, str]:
    return (list(order).index(name), name) if name in order else (len(order), name)


def _method_titles(runs: Sequence[EvaluatedRun], titles: Mapping[str, str]) -> dict[Any, str]:
    """Return the title of each run's method, by folder, with the fields that differ among runs on the same test set."""
    named: dict[Any, str] = {}
    for name in {run.name for run in runs}:
        configs = {run.folder: _method(run) for run in runs if run.name == name}
        fields: set[str] = set()
        for test_set in {run.test_set for run in runs}:
            fields |= differing([configs[run.folder] for run in runs if run.name == name and run.test_set == test_set])
        for folder, config in configs.items():
            shown_fields = [field for field in sorted(fields) if field in config]
            values = [f"{field.removesuffix('._target_')}={_value(config[field])}" for field in shown_fields]
            named[folder] = titles.get(name, name) + (f" ({', '.join(values)})" if values else "")
    return named


def _method(run: EvaluatedRun) -> dict[str, Any]:
    """Return the fields of a configuration that define the method, with paths relative to the data set."""
    root = str(run.config["data"]["root"])
    fields = settings(run.config, TABLE_ROW)
    return {k: v.replace(root, "${data.root}") if isinstance(v, str) else v for k, v in fields.items()}


def differing(configs: Sequence[Mapping[str, Any]]) -> set[str]:
    """Return the fields with different values. Fields of components are compared within the same class only."""
    fields = set()
    for key in {key for config in configs for key in config}:
        target = f"{key.rpartition('.')[0]}._target_"
        values: dict[str, set[str]] = {}
        for config in configs:
            cls = "" if key == target else str(config.get(target))
            values.setdefault(cls, set()).add(repr(config.get(key)))
        if any(len(found) > 1 for found in values.values()):
            fields.add(key)
    return fields


def _value(value: object) -> str:
    return value.rpartition(".")[2] if isinstance(value, str) and value.startswith("nerfro") else str(value)


def _scene_titles(test_sets: set[EvaluationSet], titles: Mapping[str, str]) -> dict[EvaluationSet, str]:
    """Return the titles of test sets in order, each with the properties that distinguish it from the others."""
    ordered = sorted(test_sets, key=lambda s: (*_rank(s.name, titles), s.root, s.width * s.height, _properties(s)))
    named = {}
    for scene in ordered:
        namesakes = [other for other in ordered if other.name == scene.name]
        extra = [p for p in _properties(scene) if any(p not in _properties(other) for other in ordered)]
        if len({other.root for other in namesakes}) > 1:
            extra.append(scene.root)
        extra += [f"{k}={v}" for k, v in scene.options if len({dict(o.options).get(k) for o in namesakes}) > 1]
        named[scene] = ", ".join([titles.get(scene.name, scene.name), *extra])
    return named


def _properties(test_set: EvaluationSet) -> tuple[str, str]:
    """Describe the images of a test set."""
    views = f"{test_set.num_views} {test_set.split} view{'s' if test_set.num_views != 1 else ''}"
    return views, f"{test_set.width} x {test_set.height} pixels"


def _common_description(comparison: Comparison, region: Region) -> list[str]:
    """Describe the properties that all test sets share; the titles of the test sets contain the others."""
    properties = [set(texts) for texts in zip(*map(_properties, comparison.scenes), strict=True)]
    common = [text for texts in properties if len(texts) == 1 for text in texts]
    return common + ([f"scores of the {region}"] if region != FULL else [])


def _describe_seeds(comparison: Comparison) -> str:
    """Describe the number of runs per score."""
    counts = [len(runs) for runs in comparison.cells.values()]
    least, most = min(counts), max(counts)
    if most == 1:
        return "one run each"
    return f"mean ± standard deviation over {most if least == most else f'{least} to {most}'} seeds"


def _score(runs: Sequence[EvaluatedRun], metric: str, region: Region) -> tuple[float | None, float | None]:
    """Return mean and sample standard deviation over runs; None for missing values or a single run."""
    values = [run.metrics.result.mean(metric, region) for run in runs]
    present = [value for value in values if value is not None]
    if not present or len(present) < len(values):
        return None, None
    return statistics.fmean(present), statistics.stdev(present) if len(present) > 1 else None


def _reason(run: EvaluatedRun, metric: str, region: Region) -> str | None:
    """Return the reason why a run lacks a metric, or None if it has the metric."""
    if run.metrics.result.mean(metric, region) is not None:
        return None
    notes = run.metrics.result.notes
    keys = (metric,) if region == FULL else (metric, "mask")
    return next((notes[key] for key in keys if key in notes), f"not among the scores of {shown(run.folder)}")
