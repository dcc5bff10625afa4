"""Self-contained HTML report of many runs: tables, some views of each scene by every method, and provenance."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import OmegaConf
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.paths import PACKAGE_DIR, shown
from nerfro.core.progress import duration
from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import SQUARED_ERROR_LIMIT, image_metrics, squared_error_colours
from nerfro.evaluation.results import FULL, Region, Score
from nerfro.evaluation.tables import MISSING, Table
from nerfro.files.images import data_uri, load_png, magma, to_8bit
from nerfro.files.templates import fill_template
from nerfro.report.comparison import Comparison
from nerfro.report.runs import EvaluatedRun, EvaluationSet, device
from nerfro.training.config import build_data
from nerfro.training.inputs import relocated

PNG_SIDE = 256  # pixels; larger images are embedded as JPEG to limit the size of the page


@dataclass(frozen=True)
class Selection:
    """Images that the report shows.

    Attributes:
        num_views: number of evenly spread views per scene; 0 for all.
        metric: name of the metric shown below each image.
        region: region of this metric.
    """

    num_views: int = 8
    metric: str = "psnr"
    region: Region = FULL


@dataclass(frozen=True)
class PageImage:
    """An image on the page: label, formatted score, and content as a data URI."""

    label: str
    score: str
    uri: str


@dataclass(frozen=True)
class View:
    """A view rendered by all methods.

    Attributes:
        index, name: index of the view in its split, and file of the image in the data set.
        reference: ground truth.
        predictions, errors: images and error maps, by index of the method in the comparison.
    """

    index: int
    name: str
    reference: PageImage
    predictions: Mapping[int, PageImage]
    errors: Mapping[int, PageImage]


@dataclass(frozen=True)
class SceneImages:
    """Images of one scene.

    Attributes:
        width, height: size of each image in pixels.
        views: views to choose from.
        figure: one of the views, shown as the figure.
        methods: titles of the methods by index, the best first; methods without a run on this scene are absent.
        seeds: seeds of the runs that rendered the images.
    """

    width: int
    height: int
    views: tuple[View, ...]
    figure: View
    methods: Mapping[int, str]
    seeds: Sequence[int]


def scene_images(comparison: Comparison, test_set: EvaluationSet, selection: Selection) -> SceneImages:
    """Collect the images and scores of a scene, from the first seed of each method.

    Raises:
        NerfroError: the references cannot be read, or the images of a run are missing or have another size.
    """
    cells = [comparison.cells.get((method, test_set)) for method in comparison.methods]
    runs = {number: cell[0] for number, cell in enumerate(cells) if cell}
    sign = 1 if image_metrics()[selection.metric].better == "higher" else -1

    def quality(run: EvaluatedRun) -> float:
        score = run.metrics.result.mean(selection.metric, selection.region)
        return -math.inf if score is None else sign * score

    runs = dict(sorted(runs.items(), key=lambda item: -quality(item[1])))
    titles = {number: comparison.methods[number] for number in runs}
    first = next(iter(runs.values()))
    references: Views = build_data(relocated(OmegaConf.create(dict(first.config)), first.folder)).load(test_set.split)
    if test_set.num_views == first.config["trainer"].get("limit_test_batches"):
        references = references.select(range(min(len(references), test_set.num_views)))
    cameras = references.cameras
    if (len(references), cameras.height, cameras.width) != (test_set.num_views, test_set.height, test_set.width):
        raise NerfroError(f"{test_set.root} has changed since these views were scored; restore the data set")
    figure = _median_view(list(runs.values()), selection)
    count = min(selection.num_views or test_set.num_views, test_set.num_views)
    views = {
        index: _view(index, references, runs, titles, selection)
        for index in sorted({round(i) for i in np.linspace(0, test_set.num_views - 1, count)} | {figure})
    }
    return SceneImages(
        width=test_set.width,
        height=test_set.height,
        views=tuple(views.values()),
        figure=views[figure],
        methods=titles,
        seeds=sorted({run.seed for run in runs.values()}),
    )


def _median_view(runs: Sequence[EvaluatedRun], selection: Selection) -> int:
    """Return the view whose mean score over methods is the median, so that the figure is representative."""
    scores = []
    for index in range(len(runs[0].metrics.result.views)):
        values = [_score(run, index, selection) for run in runs]
        scores.append(statistics.fmean([value for value in values if value is not None] or [0.0]))
    return scores.index(statistics.median_low(scores))


def _score(run: EvaluatedRun, view: int, selection: Selection) -> Score:
    return run.metrics.result.views[view].score(selection.metric, selection.region)


def _view(
    index: int, references: Views, runs: Mapping[int, EvaluatedRun], titles: Mapping[int, str], selection: Selection
) -> View:
    metric, name = image_metrics()[selection.metric], references.names[index]
    reference = references.images[index].clamp(0, 1)
    predictions, errors = {}, {}
    for number, run in runs.items():
        image = load_png(run.scores / "images" / f"{run.metrics.result.views[index].name}.png")
        title = titles[number]
        value = _score(run, index, selection)
        score = f"{metric.title} {MISSING if value is None else f'{value:.{metric.decimals}f}'}"
        error = squared_error_colours(image, reference)
        predictions[number] = PageImage(f"{title}, view {index}", score, embed_image(image))
        errors[number] = PageImage(f"squared error of {title}, view {index}", score, embed_image(error))
    return View(index, name, PageImage(f"reference, view {index}", "", embed_image(reference)), predictions, errors)


def embed_image(rgb: Float[Tensor, "H W 3"]) -> str:
    """Encode an image as a data URI: PNG up to `PNG_SIDE` pixels per side, otherwise JPEG."""
    pixels = to_8bit(rgb).numpy()
    if max(pixels.shape[:2]) <= PNG_SIDE:
        return data_uri(pixels, "PNG", optimize=True)
    return data_uri(pixels, "JPEG", quality=95, subsampling=0)


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
