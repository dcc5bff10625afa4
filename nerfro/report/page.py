"""Self-contained HTML report of many runs: tables, images and provenance."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from omegaconf import OmegaConf

from nerfro.core.errors import NerfroError
from nerfro.core.paths import PACKAGE_DIR, shown
from nerfro.core.progress import duration
from nerfro.evaluation.image_metrics import SQUARED_ERROR_LIMIT
from nerfro.evaluation.tables import Table
from nerfro.files.images import load_png, magma
from nerfro.files.templates import fill_template
from nerfro.report.comparison import Comparison
from nerfro.report.runs import EvaluatedRun, device
from nerfro.report.views import PNG_SIDE, Selection, embed_image, scene_images

_TEMPLATES = PACKAGE_DIR / "report"


def report_page(
    compared: Sequence[tuple[Comparison, Table]],
    unfinished: Sequence[str],
    selection: Selection,
    pictures: Sequence[Path] = (),
    folder: Path | None = None,
) -> str:
    """Create the page.

    Args:
        compared: comparisons with their tables.
        unfinished: one line about each run without scores.
        selection: images that the page shows.
        pictures: further images, PNG files.
        folder: folder of the page, from which it links to the pages of the runs; None for no links.
    """
    sections = [
        {
            "id": f"b{number}",
            "title": comparison.budget.title,
            "table": table,
            "caption": table.title.removeprefix(f"{comparison.budget.title}; "),
            "scenes": _scenes(f"b{number}", comparison, selection),
            "runs": [_run_origin(comparison, run, folder) for run in comparison.runs],
        }
        for number, (comparison, table) in enumerate(compared)
    ]
    ramp = magma(torch.linspace(0, 1, 256)[None], 1)
    return fill_template(
        _TEMPLATES / "page.html.jinja",
        sections=sections,
        unfinished=unfinished,
        pictures=[{"name": shown(file), "uri": embed_image(load_png(file))} for file in pictures],
        error_ramp=embed_image(ramp),
        error_limit=SQUARED_ERROR_LIMIT,
        png_side=PNG_SIDE,
        jpeg_quality=95,
    )


def _scenes(prefix: str, comparison: Comparison, selection: Selection) -> list[dict[str, Any]]:
    """Return the section of each scene: its identifier on the page, title, and images or the reason for their lack."""
    sections = []
    for number, (test_set, title) in enumerate(comparison.scenes.items()):
        images, reason = None, ""
        try:
            images = scene_images(comparison, test_set, selection)
        except NerfroError as error:  # a missing data set does not prevent the rest of the page
            reason = str(error)
        sections.append({"id": f"{prefix}s{number}", "title": title, "images": images, "reason": reason})
    return sections


def _run_origin(comparison: Comparison, run: EvaluatedRun, folder: Path | None) -> dict[str, Any]:
    """Return the origin of a run, as text, and the address of its page relative to `folder`, if both exist."""
    cell = next(cell for cell, runs in comparison.cells.items() if run in runs)
    facts, metrics = run.facts, run.metrics
    commit = facts.get("commit") or "not a git checkout"
    texts: dict[str, Any] = {
        "command": facts["command"],
        "commit": f"{commit}, with the changes in git.diff" if facts.get("modified") else commit,
        "device": device(run.config, facts),
        "spent": _spent(metrics.steps, metrics.train_seconds, metrics.rays_per_second),
        "versions": ", ".join(f"{name} {version}" for name, version in facts["versions"].items() if version),
        "python": facts["python"],
        "settings of algorithms": "; ".join(facts["algorithms"]) or "none",
    }
    config = OmegaConf.to_yaml(OmegaConf.create(json.loads(json.dumps(run.config))))
    method, scene = cell[0], comparison.scenes[cell[1]]
    origin = {"method": method, "scene": scene, "seed": run.seed, "folder": shown(run.folder)}
    file = run.folder / "index.html"
    page = quote(Path(os.path.relpath(file, folder)).as_posix()) if folder is not None and file.is_file() else None
    return {**origin, "facts": texts, "config": config, "page": page}


def _spent(steps: int | None, seconds: float | None, rays_per_second: float | None) -> str:
    parts = [f"{steps:,} steps" if steps is not None else "", duration(seconds) if seconds is not None else ""]
    parts.append(f"{rays_per_second:,.0f} rays/s" if rays_per_second is not None else "")
    return ", ".join(part for part in parts if part)
