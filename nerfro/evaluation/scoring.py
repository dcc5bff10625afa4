"""Scores of the rendered views of a split, or of a folder of images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tqdm import tqdm

from nerfro.data.base import Views
from nerfro.data.image_files import Alpha
from nerfro.evaluation.error_maps import write_error_sheet
from nerfro.evaluation.folders import ImagePair
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import render_view
from nerfro.evaluation.results import EvaluationResult
from nerfro.files.images import save_png
from nerfro.rendering import Renderer
from nerfro.subdivision import Subdivision


def score_views(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    subfolder: str = "images",
) -> EvaluationResult:
    """Render all views, write these as 8-bit sRGB to `folder/<subfolder>/<prefix>_NNN.png`, and compute the scores.

    The memory holds the rays and images of one view and the samples of `renderer.chunk_size` rays.
    """
    height, width = views.cameras.height, views.cameras.width
    cameras = views.cameras.to(renderer.scene.device)
    progress = tqdm(total=len(views) * height * width, unit="ray", unit_scale=True, desc="evaluate", dynamic_ncols=True)
    with progress:
        for view in range(len(views)):
            rendered = render_view(renderer, cameras, view, subdivision)
            rgb = renderer.scene.colour_space.to_display(rendered.radiance).reshape(height, width, 3).cpu()
            save_png(folder / subfolder / f"{metrics.prefix}_{view:03d}.png", rgb)
            coverage = None if views.masks is None else views.masks[view]
            metrics.update(rgb, views.images[view], view, coverage)
            progress.update(height * width)
    return metrics.result()


def score_folders(
    pairs: list[ImagePair],
    alpha: Alpha,
    metrics: ImageMetrics,
    networks: Mapping[str, LpipsNetwork],
    folder: Path,
    device: torch.device,
) -> EvaluationResult:
    """Score each prediction on a device, and write error maps to `folder/errors`."""
    metrics = metrics.to(device)
    for pair in tqdm(pairs, unit="view", desc="evaluate", dynamic_ncols=True):
        prediction, reference, coverage = pair.load(alpha)
        prediction, reference = prediction.to(device), reference.to(device)
        metrics.update(prediction, reference, coverage=None if coverage is None else coverage.to(device))
        write_error_sheet(folder, pair.name, prediction, reference, networks)
    return metrics.result([pair.name for pair in pairs])
