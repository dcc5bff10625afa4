"""Scores of test views with corrected cameras and exposures.

Training refines cameras and exposures of training views only. Scores of test views that use such corrections are listed
separately, so that the scores under `test` always belong to the cameras and exposures of the data set.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from nerfro.data.base import Views
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import AS_GIVEN, EXPOSED, EvaluationResult
from nerfro.evaluation.scoring import ScoringProtocol, score_views
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import Subdivision


def score_split(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    prefix: str,
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score views with the given cameras, and once more for each applicable treatment.

    The treatments build on each other:

    - `aligned`: test cameras are moved by the similarity transformation from the given to the refined training cameras,
      and use the estimated lens.
    - `exposed`: in addition, each view and channel has a gain.

    Gains are fitted on the left halves of the photographs, and the right halves are scored. `score_views` explains the
    arguments.

    Returns:
        Scores with the given cameras, and the scores of each treatment by name.
    """
    scene, results = renderer.scene, dict[str, EvaluationResult]()
    settings = metrics, folder, subdivision, prefix
    protocols = {AS_GIVEN: ScoringProtocol("images")}
    if scene.camera.moves:
        [results[AS_GIVEN]] = score_views(renderer, views, *settings, [*protocols.values()])
        views = replace(views, cameras=scene.camera.aligned(views.cameras))
        protocols = {"aligned": ScoringProtocol("images_aligned")}
    if scene.camera.exposure is not None:
        protocols[EXPOSED] = ScoringProtocol("images_exposed", right_halves=True)
    scores = score_views(renderer, views, *settings, [*protocols.values()])
    results |= dict(zip(protocols, scores, strict=True))
    return results.pop(AS_GIVEN), results
