"""`python -m nerfro.summary runs=[outputs]`: many runs in one table, and on one page."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Optional

import rich
from omegaconf import DictConfig, ListConfig

from nerfro.allowed import Natural
from nerfro.cli import entry_point
from nerfro.evaluation.results import FULL
from nerfro.evaluation.tables import to_rich, write_table
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.paths import user_path
from nerfro.report.comparison import compare, find_metrics, to_table
from nerfro.report.page import report_page, table_page
from nerfro.report.runs import find_runs
from nerfro.report.views import Wanted


@dataclass
class SummaryConfig:
    """What `python -m nerfro.summary` is asked."""

    # Run folders, folders that hold some at any depth, or globs of either.
    runs: Any = field(default_factory=lambda: ["outputs"])
    # Folder for the tables, one for each budget, as .csv, .md, .tex and .html, and for the report; none only prints.
    out: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    report: bool = False  # whether to write the page `report.html`, to `outputs/summary` if `out` is none
    metrics: list[str] = field(default_factory=lambda: ["psnr", "ssim", "lpips"])  # columns, see docs/metrics.md
    region: Annotated[str, Literal["full", "mask", "crop"]] = FULL  # of the pictures: full, mask or crop
    methods: dict[str, str] = field(default_factory=dict)  # titles of experiments, in the order of the rows
    scenes: dict[str, str] = field(default_factory=dict)  # titles of scenes, by the last part of the data's folder
    views: Natural = 8  # number of views of each scene on the page, evenly spread; 0 for all
    view: Any = None  # views of the figures, as in {torus: 3}; otherwise those of the median score
    # Insets of the figures, as in {torus: [[top, left, size], ...]}, pixels; otherwise those where methods differ most.
    crops: Any = None
    error_map: str = "squared_error"  # what the error maps show: squared_error, ssim, lpips, lpips_vgg or flip
    overwrite: bool = False  # whether files in `out` may be replaced


@entry_point("summary", SummaryConfig)
def main(config: DictConfig) -> None:
    """Read, compare, print, write."""
    metrics = find_metrics(config.metrics)
    wanted = Wanted.of(config.views, config.view, config.crops, config.error_map, metrics[0], config.region)
    places = list(config.runs) if isinstance(config.runs, ListConfig) else [str(config.runs)]
    runs, unfinished = find_runs(places)
    wanted.check([run.scored for run in runs])
    comparisons = compare(runs, config.methods, config.scenes)
    tables = {c.budget.file_name: to_table(c, metrics, config.region) for c in comparisons}

    folder = "outputs/summary" if config.out is None and config.report else config.out
    out = None if folder is None else user_path(folder)
    if out is not None:
        names = [name + suffix for name in tables for suffix in (".csv", ".md", ".tex", ".html")]
        written = [*names, "report.html"] if config.report else names
        refuse_existing([out / name for name in written], config.overwrite)
    for table in tables.values():
        rich.print(to_rich(table))
    for line in unfinished:
        print(line)
    if out is None:
        return
    for name, table in tables.items():
        write_table(table, out / name)
        write_atomically(out / f"{name}.html", table_page(table))
    print(f"tables: {out}")
    if config.report:
        page = report_page(list(zip(comparisons, tables.values(), strict=True)), unfinished, wanted)
        write_atomically(out / "report.html", page)
        print(f"report: {out / 'report.html'}, {len(page) / 2**20:.1f} MiB")


if __name__ == "__main__":
    main()
