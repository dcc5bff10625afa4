"""`python -m nerfro.summary runs=[outputs]`: compare many runs in tables and in a report.

Examples:
    nerfro summary 'runs=[outputs]'
    nerfro summary 'runs=[outputs/first,outputs/straight]' out=outputs/report report=true
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Optional

import rich
from omegaconf import DictConfig, ListConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.core.paths import user_path
from nerfro.evaluation.results import FULL
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


@entry_point("summary", SummaryConfig)
def main(config: DictConfig) -> None:
    """Read and compare runs, and print and write the result."""
    metrics = find_metrics(config.metrics)
    places = [str(place) for place in (config.runs if isinstance(config.runs, ListConfig) else [config.runs])]
    runs, unfinished = find_runs(places)
    comparisons = compare(runs, config.methods, config.scenes)
    tables = {c.budget.file_name: to_table(c, metrics, config.region) for c in comparisons}

    folder = "outputs/summary" if config.out is None and config.report else config.out
    if folder is None:
        _print(tables, unfinished)
        return
    out = user_path(folder)
    with lock_folder(out, "out"):
        names = [name + suffix for name in tables for suffix in (".csv", ".md", ".tex")]
        written = [*names, "report.html"] if config.report else names
        refuse_existing([out / name for name in written], config.overwrite)
        _print(tables, unfinished)
        for name, table in tables.items():
            write_table(table, out / name)
        print(f"tables: {out}")
        if config.report:
            selection = Selection(config.views, next(iter(metrics)), config.region)
            page = report_page(list(zip(comparisons, tables.values(), strict=True)), unfinished, selection)
            write_atomically(out / "report.html", page)
            print(f"report: {out / 'report.html'}, {len(page) / 2**20:.1f} MiB")


def _print(tables: Mapping[str, Table], unfinished: Sequence[str]) -> None:
    for table in tables.values():
        rich.print(to_rich(table))
    for line in unfinished:
        print(line)


if __name__ == "__main__":
    main()
