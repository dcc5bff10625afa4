"""Scores of test views with corrected cameras and exposures.

Training refines cameras and exposures of training views only. Scores of test views that use such corrections are listed
separately, so that the scores under `test` always belong to the cameras and exposures of the data set.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.camera.exposure import fit_gain
from nerfro.data.base import Views
from nerfro.evaluation.left_halves import refine_on_left
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import render_view
from nerfro.evaluation.results import EvaluationResult
from nerfro.evaluation.scoring import score_views
from nerfro.files.images import save_png
from nerfro.rendering import Renderer
from nerfro.subdivision import Subdivision


def score_split(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    refine_steps: int = 0,
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score views with the given cameras, and once more for each applicable treatment.

    The treatments build on each other:

    - `aligned`: test cameras are moved by the similarity transformation from the given to the refined training cameras,
      and use the estimated lens.
    - `exposed`: in addition, each view and channel has a gain.
    - `refined`: in addition, each test camera is refined individually.

    Gains and refined cameras are fitted on the left halves of the photographs, and the right halves are scored.

    Returns:
        Scores with the given cameras, and the scores of each treatment by name.
    """
    given, treated = score_views(renderer, views, metrics, folder, subdivision), {}
    if renderer.scene.camera.moves:
        views = replace(views, cameras=renderer.scene.camera.aligned(views.cameras))
        metrics.reset()
        treated["aligned"] = score_views(renderer, views, metrics, folder, subdivision, "images_aligned")
    gains = torch.ones(len(views), 3)
    if renderer.scene.camera.exposure is not None:
        metrics.reset()
        gains, treated["exposed"] = _score_right(renderer, views, metrics, folder, subdivision, "exposed")
    if refine_steps:
        views = replace(views, cameras=refine_on_left(renderer, views, gains, refine_steps))
        metrics.reset()
        _, treated["refined"] = _score_right(renderer, views, metrics, folder, subdivision, "refined")
    return given, treated


def _score_right(
    renderer: Renderer, views: Views, metrics: ImageMetrics, folder: Path, subdivision: Subdivision, name: str
) -> tuple[Float[Tensor, "V 3"], EvaluationResult]:
    """Fit gains on left halves if exposures are estimated (otherwise 1), and score right halves."""
    cameras = views.cameras.to(renderer.scene.device)
    height, width = cameras.height, cameras.width
    left, right = slice(width // 2), slice(width // 2, None)
    gains = torch.ones(len(views), 3)
    for view in range(len(views)):
        radiance = render_view(renderer, cameras, view, subdivision).radiance.view(height, width, 3).cpu()
        target = views.images[view]
        if renderer.scene.camera.exposure is not None:
            gains[view] = fit_gain(
                renderer.scene.colour_space.to_srgb, radiance[:, left].flatten(0, 1), target[:, left].flatten(0, 1)
            )
        rgb = renderer.scene.colour_space.to_display(gains[view] * radiance)
        save_png(folder / f"images_{name}" / f"{metrics.prefix}_{view:03d}.png", rgb)
        coverage = None if views.masks is None else views.masks[view][:, right].contiguous()
        metrics.update(rgb[:, right].contiguous(), target[:, right].contiguous(), view, coverage)
    return gains, metrics.result()
