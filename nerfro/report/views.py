"""Images of the report: some views of a scene by every method, with error maps."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import image_metrics, squared_error_colours
from nerfro.evaluation.results import FULL, Region, Score
from nerfro.evaluation.tables import MISSING
from nerfro.files.images import data_uri, load_png, to_8bit
from nerfro.report.comparison import Comparison
from nerfro.report.runs import EvaluatedRun, EvaluationSet
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
