"""The pictures of a comparison's page: some views of a scene by every method, their errors, and insets."""

from __future__ import annotations

import base64
import io
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from nerfro.data.base import Views
from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import ErrorMap, error_maps
from nerfro.evaluation.image_grid import Crop, most_different_crop
from nerfro.evaluation.lpips import LpipsNetwork, find_lpips_networks
from nerfro.evaluation.results import FULL, METRICS, Metric, Region, Score
from nerfro.evaluation.tables import MISSING
from nerfro.files.images import load_png, to_8bit
from nerfro.report.comparison import Comparison
from nerfro.report.runs import Run, Scored
from nerfro.training.config import build_data

ERROR_MAPS = ("squared_error", "ssim", "lpips", "lpips_vgg", "flip")
NUM_CROPS = 2
CROP_SHARE = 4  # an inset's side is this part of the picture's shorter one
PNG_SIDE = 256  # pixels; larger pictures are embedded as JPEG, or a page of many would not load
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Wanted:
    """Which pictures a page shows."""

    num_views: int  # of each scene, evenly spread; 0 for all
    view: Mapping[str, int]  # of the figure, by the scene's name
    crops: Mapping[str, tuple[Crop, ...]]  # insets of the figure, by the scene's name
    error_map: str  # one of `ERROR_MAPS`
    lpips_networks: Mapping[str, LpipsNetwork]  # those that it needs
    metric: Metric  # whose value stands below each picture
    region: Region  # that it was measured on

    @classmethod
    def of(
        cls,
        num_views: int,
        view: Any,
        crops: Any,
        error_map: str = "squared_error",
        metric: Metric = METRICS[0],
        region: Region = FULL,
    ) -> Wanted:
        """Check the form of what the user gave; `view` and `crops` may be None."""
        if error_map not in ERROR_MAPS:
            raise NerfroError(f"error_map={error_map} is not an error map; choose from {', '.join(ERROR_MAPS)}")
        networks, reasons = find_lpips_networks() if error_map.startswith("lpips") else ({}, {})
        if error_map in reasons:
            raise NerfroError(f"error_map={error_map}: {reasons[error_map]}")
        if num_views < 0:
            raise NerfroError(f"views={num_views} is not a number of views; give 1 or more, or 0 for all")
        try:
            chosen = {str(scene): int(index) for scene, index in (view or {}).items()}
        except (AttributeError, TypeError, ValueError) as error:
            raise NerfroError(f"view={view} does not name views of scenes; give {{SCENE: INDEX}}") from error
        try:
            insets = {
                str(scene): tuple(Crop(*map(int, square)) for square in squares)
                for scene, squares in (crops or {}).items()
            }
        except (AttributeError, TypeError, ValueError) as error:
            raise NerfroError(
                f"crops={crops} does not name squares; give {{SCENE: [[TOP, LEFT, SIZE], ...]}} in pixels"
            ) from error
        return cls(num_views, chosen, insets, error_map, networks, metric, region)

    def check(self, scenes: Sequence[Scored]) -> None:
        """Refuse what fits no scene."""
        named = {scene.name: scene for scene in scenes}
        for name in (*self.view, *self.crops):
            if name not in named:
                raise NerfroError(f"'{name}' is not a scene of these runs; choose from {', '.join(sorted(named))}")
        for scene in scenes:
            if not 0 <= self.view.get(scene.name, 0) < scene.num_views:
                raise NerfroError(
                    f"view.{scene.name}={self.view[scene.name]} is not a view; give 0 to {scene.num_views - 1}"
                )
            for crop in self.crops.get(scene.name, ()):
                if crop.size < 1 or not crop.inside(scene.height, scene.width):
                    raise NerfroError(
                        f"crops.{scene.name}: {crop} does not lie inside {scene.width} x {scene.height} pixels"
                    )


@dataclass(frozen=True)
class Shown:
    """A picture on the page: what it shows in words, and its value of the metric; the picture itself as a data URI."""

    label: str
    score: str
    uri: str


@dataclass(frozen=True)
class View:
    """A view by all methods that rendered it."""

    index: int  # of the view in its split
    reference: Shown  # the ground truth
    predictions: Mapping[int, Shown]  # of the methods, by their number in the comparison
    errors: Mapping[int, Shown]


@dataclass(frozen=True)
class ScenePictures:
    """What a page shows of a scene."""

    width: int  # of each picture, in pixels
    height: int
    views: tuple[View, ...]  # those that can be chosen
    figure: View  # the view of the figure, one of them
    crops: tuple[Crop, ...]  # its insets
    error_title: str  # what the error maps show
    error_limit: float  # error at the last colour of their scale
    methods: Mapping[int, str]  # titles by number; those that have not been trained on this scene are absent
    seeds: Sequence[int]  # of the runs whose pictures these are


def scene_pictures(comparison: Comparison, scored: Scored, wanted: Wanted) -> ScenePictures:
    """Gather the pictures of a scene, of each method those of its first seed, with their scores.

    Raises:
        NerfroError: the references cannot be read, or a run's pictures are missing or of another size.
    """
    cells = [comparison.cells.get((method, scored)) for method in comparison.methods]
    runs = {number: cell[0] for number, cell in enumerate(cells) if cell}
    titles = {number: comparison.methods[number] for number in runs}
    first = next(iter(runs.values()))
    references: Views = build_data(OmegaConf.create(dict(first.config))).load(scored.split)
    cameras = references.cameras
    if (len(references), cameras.height, cameras.width) != (scored.num_views, scored.height, scored.width):
        raise NerfroError(f"{scored.root} does not hold the views that were scored; has it been changed since?")
    figure = wanted.view.get(scored.name, _median_view(list(runs.values()), wanted))
    count = min(wanted.num_views or scored.num_views, scored.num_views)
    views = {
        index: _view(index, references.images[index], runs, titles, wanted)
        for index in sorted({round(i) for i in np.linspace(0, scored.num_views - 1, count)} | {figure})
    }
    reference, predictions = references.images[figure], [_prediction(run, figure) for run in runs.values()]
    error = _error_map(predictions[0], reference, wanted)
    crops = wanted.crops.get(scored.name)
    if crops is None:
        crops = _choose_crops(reference, predictions)
    return ScenePictures(
        width=scored.width,
        height=scored.height,
        views=tuple(views.values()),
        figure=views[figure],
        crops=crops,
        error_title=error.title,
        error_limit=error.limit,
        methods=titles,
        seeds=sorted({run.seed for run in runs.values()}),
    )


def _median_view(runs: Sequence[Run], wanted: Wanted) -> int:
    """The view whose mean score over methods is the median: neither the best nor the worst that could be shown."""
    scores = []
    for index in range(len(runs[0].metrics.result.views)):
        values = [_score(run, index, wanted) for run in runs]
        scores.append(statistics.fmean([value for value in values if value is not None] or [0.0]))
    return scores.index(statistics.median_low(scores))


def _score(run: Run, view: int, wanted: Wanted) -> Score:
    return run.metrics.result.views[view].score(wanted.metric.name, wanted.region)


def _view(index: int, reference: Tensor, runs: Mapping[int, Run], titles: Mapping[int, str], wanted: Wanted) -> View:
    metric = wanted.metric
    predictions, errors = {}, {}
    for number, run in runs.items():
        picture, title = _prediction(run, index), titles[number]
        value = _score(run, index, wanted)
        score = f"{metric.title} {MISSING if value is None else f'{value:.{metric.decimals}f}'}"
        error = _error_map(picture, reference, wanted)
        predictions[number] = Shown(f"{title}, view {index}", score, data_uri(picture))
        errors[number] = Shown(f"{error.title} of {title}, view {index}", score, data_uri(error.colours()))
    return View(index, Shown(f"reference, view {index}", "", data_uri(reference)), predictions, errors)


def _error_map(prediction: Tensor, reference: Tensor, wanted: Wanted) -> ErrorMap:
    for found in error_maps(prediction, reference, wanted.lpips_networks):
        if found.name == wanted.error_map:
            return found
    raise NerfroError(f"pictures of {list(reference.shape[:2])} pixels are too small for error_map={wanted.error_map}")


def _prediction(run: Run, index: int) -> Float[Tensor, "H W 3"]:
    return load_png(run.folder / "images" / f"{run.metrics.result.views[index].name}.png")


def _choose_crops(reference: Tensor, predictions: Sequence[Tensor]) -> tuple[Crop, ...]:
    size = max(min(reference.shape[:2]) // CROP_SHARE, 1)
    crops: list[Crop] = []
    for _ in range(NUM_CROPS):
        crops.append(most_different_crop(reference, predictions, size, apart_from=crops))
    return tuple(crops)


def data_uri(picture: Float[Tensor, "H W 3"]) -> str:
    """A picture as text: PNG up to `PNG_SIDE` pixels a side, JPEG beyond."""
    exact = max(picture.shape[:2]) <= PNG_SIDE
    encoded = io.BytesIO()
    image = Image.fromarray(to_8bit(picture).numpy())
    if exact:
        image.save(encoded, format="PNG", optimize=True)
    else:
        image.save(encoded, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return f"data:image/{'png' if exact else 'jpeg'};base64,{base64.b64encode(encoded.getvalue()).decode()}"
