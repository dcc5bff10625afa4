"""Comparison of runs: tables and the report, from the options of `nerfro.summary`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Optional, cast

import rich

from nerfro.core.paths import user_path
from nerfro.evaluation.results import FULL, Region
from nerfro.evaluation.tables import Table, to_rich, write_table
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.files.folder_lock import lock_folder
from nerfro.registry.allowed import Natural
from nerfro.report.comparison import compare, find_metrics, to_table
from nerfro.report.page import report_page
from nerfro.report.runs import find_runs
from nerfro.report.views import Selection


@dataclass
class SummaryConfig:
    """Options of `python -m nerfro.summary`."""

    # Run folders, folders that contain these at any depth, or glob patterns.
    runs: Any = field(default_factory=lambda: ["outputs"])
    # Folder for the report and the tables (.csv, .md and .tex, one table per budget); without it, only print.
    out: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    report: bool = False  # whether to write `report.html`; the default of `out` is then `outputs/summary`
    # Columns of the tables; by default psnr, ssim, lpips, flip and the metrics of plugins, as far as runs have them.
    metrics: Optional[list[str]] = None  # noqa: UP045
    region: Annotated[str, Literal["full", "mask", "crop"]] = FULL  # region of the scores: full, mask or crop
    methods: dict[str, str] = field(default_factory=dict)  # titles of experiments, in the order of the rows
    scenes: dict[str, str] = field(default_factory=dict)  # titles of scenes, by the last component of the data folder
    views: Natural = 8  # number of evenly spread views per scene in the report; 0 for all
    overwrite: bool = False  # whether to replace files in `out`


def summarize(options: SummaryConfig) -> None:
    """Read and compare runs, and print and write the result."""
    metrics, region = find_metrics(options.metrics), cast(Region, options.region)
    patterns = options.runs if isinstance(options.runs, list) else [options.runs]
    runs, unfinished = find_runs([str(pattern) for pattern in patterns])
    comparisons = compare(runs, options.methods, options.scenes)
    tables = {c.budget.file_name: to_table(c, metrics, region) for c in comparisons}

    folder = "outputs/summary" if options.out is None and options.report else options.out
    if folder is None:
        _print(tables, unfinished)
        return
    out = user_path(folder)
    with lock_folder(out, "out"):
        names = [name + suffix for name in tables for suffix in (".csv", ".md", ".tex")]
        written = [*names, "report.html"] if options.report else names
        refuse_existing([out / name for name in written], options.overwrite)
        _print(tables, unfinished)
        for name, table in tables.items():
            write_table(table, out / name)
        print(f"tables: {out}")
        if options.report:
            selection = Selection(options.views, next(iter(metrics)), region)
            page = report_page(list(zip(comparisons, tables.values(), strict=True)), unfinished, selection)
            write_atomically(out / "report.html", page)
            print(f"report: {out / 'report.html'}, {len(page) / 2**20:.1f} MiB")


def _print(tables: Mapping[str, Table], unfinished: Sequence[str]) -> None:
    for table in tables.values():
        rich.print(to_rich(table))
    for line in unfinished:
        print(line)
