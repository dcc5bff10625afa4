"""Comparison of runs: tables and the report, from the options of `nerfro.summary`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import rich

from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import FULL, Region
from nerfro.evaluation.tables import FORMATS, Table, to_rich, write_table
from nerfro.files.atomic import lock_folder, refuse_existing, write_atomically
from nerfro.files.images import load_png
from nerfro.registry.allowed import Natural
from nerfro.report.comparison import compare, to_table
from nerfro.report.page import Selection, report_page
from nerfro.report.runs import find_runs

_METHODS = {
    "nerf": "NeRF",
    "mipnerf": "mip-NeRF",
    "mipnerf_sky": "mip-NeRF + sky",
    "eikonal_fields": "Eikonal Fields",
    "refractive": "refractive",
    "ablation_noH": "refractive w/o H",
    "ablation_noBD": "refractive w/o BD",
    "glass": "glass",
    "glass_noReflection": "glass w/o reflection",
    "glass_noTint": "glass w/o tint",
    "paper_nerf": "NeRF (paper)",
    "paper_mipnerf": "mip-NeRF (paper)",
    "paper_mipnerf_sky": "mip-NeRF + sky (paper)",
    "paper_refractive": "refractive (paper)",
    "paper_ablation_noH": "refractive w/o H (paper)",
    "paper_ablation_noBD": "refractive w/o BD (paper)",
}
_SCENES = {
    "torus": "Torus",
    "ship": "Ship",
    "deerglobe": "DeerGlobe",
    "starlamp": "StarLamp",
    "dolphin": "Dolphin",
    "ball": "Ball",
    "glass": "Glass",
    "pen": "Pen",
}


@dataclass
class SummaryConfig:
    """Options of `python -m nerfro.summary`.

    Attributes:
        runs: run folders, folders that contain these at any depth, or glob patterns.
        out: folder for the report and the tables (.csv, .md and .tex, one table per budget); without it, only
            print.
        report: whether to write `report.html`; the default of `out` is then `outputs/summary`.
        metrics: columns of the tables; by default psnr, ssim, lpips, flip and the metrics of plugins, as far as
            runs have them.
        region: region of the scores: full, mask or crop.
        methods: titles of experiments, in the order of the rows, beside those of the experiments of nerfro.
        scenes: titles of scenes, by the last component of the data folder, beside those of known scenes.
        views: number of evenly spread views per scene in the report; 0 for all.
        pictures: PNG files that the report shows after the scores, such as `trials/hypotheses.png` of
            `nerfro.reconstruct`.
        overwrite: whether to replace files in `out`.
    """

    runs: Any = field(default_factory=lambda: ["outputs"])
    out: str | None = None
    report: bool = False
    metrics: list[str] | None = None
    region: Literal["full", "mask", "crop"] = FULL
    methods: dict[str, str] = field(default_factory=dict)
    scenes: dict[str, str] = field(default_factory=dict)
    views: Natural = 8
    pictures: list[str] = field(default_factory=list)
    overwrite: bool = False


def summarize(options: SummaryConfig) -> None:
    """Read and compare runs, and print and write the result."""
    metrics, region = image_metrics(options.metrics), cast(Region, options.region)
    if options.pictures and not options.report:
        raise NerfroError(f"pictures={options.pictures} are shown in the report; add report=true")
    pictures = [user_path(file) for file in options.pictures]
    for file in pictures:  # before the runs are read
        load_png(file)
    patterns = options.runs if isinstance(options.runs, list) else [options.runs]
    runs, unfinished = find_runs([str(pattern) for pattern in patterns])
    comparisons = compare(runs, _METHODS | options.methods, _SCENES | options.scenes)
    tables = {c.budget.file_name: to_table(c, metrics, region) for c in comparisons}

    folder = "outputs/summary" if options.out is None and options.report else options.out
    if folder is None:
        _print(tables, unfinished)
        return
    out = user_path(folder)
    with lock_folder(out, "out"):
        names = [name + suffix for name in tables for suffix in FORMATS]
        written = [*names, "report.html"] if options.report else names
        refuse_existing([out / name for name in written], options.overwrite)
        _print(tables, unfinished)
        for name, table in tables.items():
            write_table(table, out / name)
        print(f"tables: {out}")
        if options.report:
            selection = Selection(options.views, next(iter(metrics)), region)
            compared = list(zip(comparisons, tables.values(), strict=True))
            page = report_page(compared, unfinished, selection, pictures, out)
            write_atomically(out / "report.html", page)
            print(f"report: {out / 'report.html'}, {len(page) / 2**20:.1f} MiB")


def _print(tables: Mapping[str, Table], unfinished: Sequence[str]) -> None:
    for table in tables.values():
        rich.print(to_rich(table))
    for line in unfinished:
        print(line)
