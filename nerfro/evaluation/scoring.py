"""Scores of the rendered views of a split, or of a folder of images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from nerfro.camera.exposure import fit_gain
from nerfro.core.progress import track
from nerfro.data.base import Views
from nerfro.data.image_files import Alpha
from nerfro.evaluation.error_sheets import write_error_sheet
from nerfro.evaluation.folders import ImagePair
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import render_view
from nerfro.evaluation.results import EvaluationResult, ViewScores
from nerfro.files.images import save_png
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import Subdivision


@dataclass(frozen=True)
class ScoringProtocol:
    """Treatment of rendered images before they are scored.

    Attributes:
        subfolder: name of the folder of the images.
        right_halves: score only the right half of each view, with the gain that is fitted on the left half of the
            photograph.
    """

    subfolder: str
    right_halves: bool = False


def score_views(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    prefix: str,
    protocols: Sequence[ScoringProtocol],
) -> list[EvaluationResult]:
    """Render all views, write 8-bit sRGB images to `folder/<subfolder>/<prefix>_NNN.png`, and compute their scores.

    The memory holds the rays and images of one view and the samples of `renderer.chunk_size` rays.

    Args:
        renderer: trained model.
        views: views to score.
        metrics: metrics of an image.
        folder: folder of the evaluation.
        subdivision: which pixels get several rays.
        prefix: beginning of the names of the views, which end with a number of three digits.
        protocols: treatments of each rendered image.

    Returns:
        Scores by each protocol.
    """
    scene, height, width = renderer.scene, views.cameras.height, views.cameras.width
    cameras, left = views.cameras.to(scene.device), slice(width // 2)
    scores: list[list[ViewScores]] = [[] for _ in protocols]
    for view in track("evaluate", range(len(views))):
        radiance = render_view(renderer, cameras, view, subdivision).radiance.view(height, width, 3).cpu()
        target, mask = views.images[view], None if views.masks is None else views.masks[view]
        name = f"{prefix}_{view:03d}"
        for protocol, scored in zip(protocols, scores, strict=True):
            gain = torch.ones(3)
            if protocol.right_halves:
                to_srgb, shown = scene.colour_space.to_srgb, radiance[:, left].flatten(0, 1)
                gain = fit_gain(to_srgb, shown, target[:, left].flatten(0, 1))
            rgb = scene.colour_space.to_display(radiance, gain)
            save_png(folder / protocol.subfolder / f"{name}.png", rgb)
            part = slice(width // 2, None) if protocol.right_halves else slice(None)
            coverage = None if mask is None else mask[:, part].contiguous()
            scored.append(metrics.score(name, rgb[:, part].contiguous(), target[:, part].contiguous(), coverage))
    return [metrics.result(scored) for scored in scores]


def score_folders(
    pairs: list[ImagePair],
    alpha: Alpha,
    metrics: ImageMetrics,
    folder: Path,
    device: torch.device,
) -> EvaluationResult:
    """Score each prediction on a device, and write error maps to `folder/errors`."""
    metrics, scores = metrics.to(device), []
    for pair in track("evaluate", pairs):
        prediction, reference, coverage = pair.load(alpha)
        prediction, reference = prediction.to(device), reference.to(device)
        coverage = None if coverage is None else coverage.to(device)
        scores.append(metrics.score(pair.name, prediction, reference, coverage))
        write_error_sheet(folder, pair.name, prediction, reference, metrics.metrics)
    return metrics.result(scores)
