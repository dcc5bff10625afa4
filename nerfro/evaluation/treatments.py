"""Test views under other cameras and exposures than the data's, each scored under its own name.

Trained cameras and gains are those of training views. What they say of a test view is scored apart, so that no number
under `test` has been helped.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.data.base import Views
from nerfro.evaluation.left_halves import refine_on_left
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling, render_view
from nerfro.evaluation.results import EvaluationResult
from nerfro.evaluation.scoring import score_views
from nerfro.files.images import save_png
from nerfro.models.base import NerfModel

# Newton's steps to a gain; each doubles the digits.
_STEPS = 20


def score_split(
    model: NerfModel,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    supersampling: Supersampling,
    refine_steps: int = 0,
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score views as given, and once more for each treatment that is asked for, by its name.

    `aligned`: cameras moved by the similarity that has moved the training cameras, and behind the lens that is believed
    in. `exposed`: these, with a gain for each view and channel. `refined`: these, each camera refined by itself. Gains
    and cameras are fitted on the left halves of photographs, and then the right halves are scored.
    """
    given, treated = score_views(model, views, metrics, folder, supersampling), {}
    if model.camera.moves:
        views = replace(views, cameras=model.camera.aligned(views.cameras))
        metrics.reset()
        treated["aligned"] = score_views(model, views, metrics, folder, supersampling, "images_aligned")
    gains = torch.ones(len(views), 3)
    if model.camera.exposure is not None:
        metrics.reset()
        gains, treated["exposed"] = _score_right(model, views, metrics, folder, supersampling, "exposed")
    if refine_steps:
        views = replace(views, cameras=refine_on_left(model, views, gains, refine_steps))
        metrics.reset()
        _, treated["refined"] = _score_right(model, views, metrics, folder, supersampling, "refined")
    return given, treated


def _score_right(
    model: NerfModel, views: Views, metrics: ImageMetrics, folder: Path, supersampling: Supersampling, name: str
) -> tuple[Float[Tensor, "V 3"], EvaluationResult]:
    """Gains that are fitted on left halves where exposures learn, else 1; and the scores of right halves."""
    cameras = views.cameras.to(model.device)
    height, width = cameras.height, cameras.width
    left, right = slice(width // 2), slice(width // 2, None)
    gains = torch.ones(len(views), 3)
    for view in range(len(views)):
        radiance = render_view(model, cameras, view, supersampling).radiance.view(height, width, 3).cpu()
        target = views.images[view]
        if model.camera.exposure is not None:
            gains[view] = fit_gain(model, radiance[:, left].flatten(0, 1), target[:, left].flatten(0, 1))
        rgb = model.photographed(gains[view] * radiance)
        save_png(folder / f"images_{name}" / f"{metrics.prefix}_{view:03d}.png", rgb)
        coverage = None if views.masks is None else views.masks[view][:, right].contiguous()
        metrics.update(rgb[:, right].contiguous(), target[:, right].contiguous(), view, coverage)
    return gains, metrics.result()


def fit_gain(model: NerfModel, radiance: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]) -> Float[Tensor, "3"]:
    """Gain of each channel of linear radiance that brings its sRGB nearest to a picture's (Gauss-Newton)."""
    radiance, target = radiance.double(), target.double()
    logarithm = torch.zeros(3, dtype=torch.float64)
    for _ in range(_STEPS):
        with torch.enable_grad():
            each = logarithm.expand_as(radiance).clone().requires_grad_()
            shown = model.encode(each.exp() * radiance)
            (slope,) = torch.autograd.grad(shown.sum(), each)
        # Saturated pixels tell nothing where the photograph is saturated, too.
        error = torch.where((target >= 1) & (shown > 1), 0.0, shown.detach() - target)
        slope = torch.where((target >= 1) & (shown > 1), 0.0, slope)
        step = (slope * error).sum(0) / slope.square().sum(0).clamp(min=1e-12)
        logarithm = logarithm - step.clamp(-1, 1)
    return logarithm.exp().to(torch.float32)
