"""Scores of test views with corrected cameras and exposures.

Training refines cameras and exposures of training views only. Scores of test views that use such corrections are listed
separately, so that the scores under `test` always belong to the cameras and exposures of the data set.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from nerfro.data.base import Views
from nerfro.evaluation.left_halves import refine_on_left
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import EvaluationResult
from nerfro.evaluation.scoring import score_views
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
    scene, gains = renderer.scene, torch.ones(len(views), 3)
    given, _ = score_views(renderer, views, metrics, folder, subdivision)
    treated: dict[str, EvaluationResult] = {}
    if scene.camera.moves:
        views = replace(views, cameras=scene.camera.aligned(views.cameras))
        treated["aligned"], _ = score_views(renderer, views, metrics, folder, subdivision, "images_aligned")
    if scene.camera.exposure is not None:
        treated["exposed"], gains = score_views(
            renderer, views, metrics, folder, subdivision, "images_exposed", right_halves=True
        )
    if refine_steps:
        views = replace(views, cameras=refine_on_left(renderer, views, gains, refine_steps))
        treated["refined"], _ = score_views(
            renderer, views, metrics, folder, subdivision, "images_refined", right_halves=True
        )
    return given, treated
