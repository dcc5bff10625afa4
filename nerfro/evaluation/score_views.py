"""Rendering the views of a split, writing the pictures and scoring them."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

from nerfro.data.base import Views
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling, render_view
from nerfro.evaluation.results import EvaluationResult
from nerfro.files.images import save_png
from nerfro.models.base import NerfModel


def score_views(
    model: NerfModel, views: Views, metrics: ImageMetrics, folder: Path, supersampling: Supersampling
) -> EvaluationResult:
    """Render every view as `folder/images/<prefix>_NNN.png` (8-bit sRGB, rounded) and score it.

    Memory: one view's rays and pictures, plus `model.chunk_size` rays' samples and activations.
    """
    height, width = views.cameras.height, views.cameras.width
    cameras = views.cameras.to(model.device)
    progress = tqdm(total=len(views) * height * width, unit="ray", unit_scale=True, desc="evaluate", dynamic_ncols=True)
    with progress:
        for view in range(len(views)):
            rendered = render_view(model, cameras, view, supersampling)
            rgb = model.encode(rendered.radiance).clamp(0, 1).reshape(height, width, 3).cpu()
            save_png(folder / "images" / f"{metrics.prefix}_{view:03d}.png", rgb)
            coverage = None if views.masks is None else views.masks[view]
            metrics.update(rgb, views.images[view], view, coverage)
            progress.update(height * width)
    return metrics.result()
