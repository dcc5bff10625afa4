"""Scores of test views with corrected cameras and exposures.

Training refines cameras and exposures of training views only. Scores of test views that use such corrections are listed
separately, so that the scores under `test` always belong to the cameras and exposures of the data set.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.camera.gauss_newton import Step, gauss_newton_step, informative_pixels
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import AS_GIVEN, EXPOSED, REFINED, EvaluationResult
from nerfro.evaluation.scoring import Images, score_views
from nerfro.rays import Rays
from nerfro.rendering import Renderer
from nerfro.subdivision import Subdivision

# Pixels per view and step, and candidates drawn per pixel; the candidates with the most contrast are used.
_NUM_PIXELS, _NUM_CANDIDATES = 600, 3
# Distance of finite differences in pixels, in the first and in the last step.
_FIRST_DIFFERENCE, _LAST_DIFFERENCE = 2.0, 0.5
# Scale of the robust error in sRGB, and maximum motion of a camera in one step in pixels.
_ERROR_SCALE, _MAX_PIXELS = 0.3, 3.0


def score_split(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    prefix: str,
    refine_steps: int = 0,
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score views with the given cameras, and once more for each applicable treatment.

    The treatments build on each other:

    - `aligned`: test cameras are moved by the similarity transformation from the given to the refined training cameras,
      and use the estimated lens.
    - `exposed`: in addition, each view and channel has a gain.
    - `refined`: in addition, each test camera is refined individually.

    Gains and refined cameras are fitted on the left halves of the photographs, and the right halves are scored.
    `score_views` explains the arguments; `refine_steps` is the number of steps for each test camera.

    Returns:
        Scores with the given cameras, and the scores of each treatment by name.
    """
    scene, results = renderer.scene, dict[str, EvaluationResult]()
    settings = metrics, folder, subdivision, prefix
    images = {AS_GIVEN: Images("images")}
    if scene.camera.moves:
        [results[AS_GIVEN]], _ = score_views(renderer, views, *settings, [*images.values()])
        views = replace(views, cameras=scene.camera.aligned(views.cameras))
        images = {"aligned": Images("images_aligned")}
    if scene.camera.exposure is not None:
        images[EXPOSED] = Images("images_exposed", right_halves=True)
    scores, gains = score_views(renderer, views, *settings, [*images.values()])
    results |= dict(zip(images, scores, strict=True))
    if refine_steps:
        views = replace(views, cameras=refine_on_left(renderer, views, gains, refine_steps))
        [results[REFINED]], _ = score_views(renderer, views, *settings, [Images("images_refined", True)])
    return results.pop(AS_GIVEN), results


@torch.no_grad()
def refine_on_left(renderer: Renderer, views: Views, gains: Float[Tensor, "V 3"], steps: int) -> Cameras:
    """Refine each camera so that the rendering of the fixed scene matches the left half of the photograph.

    Args:
        renderer: trained model, which stays unchanged.
        views: test views.
        gains: gain of each view and channel.
        steps: number of Gauss-Newton steps.
    """
    cameras, device = views.cameras.to(renderer.scene.device), renderer.scene.device
    camera = RefinedCamera(fix_gauge=False).to(device)
    camera.begin(cameras)
    photographs, gains = PixelStore(views.images).to(device), gains.to(device)
    generator, shape = torch.Generator().manual_seed(0), (len(views), _NUM_CANDIDATES * _NUM_PIXELS)

    def photographed(pixels: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return photographs[pixels]

    def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return renderer.scene.colour_space.to_display(renderer.radiance(rays), gains[view])

    for step in range(steps):
        row = torch.randint(cameras.height, shape, generator=generator)
        column = torch.randint(cameras.width // 2, shape, generator=generator)
        candidates = (torch.arange(len(views))[:, None] * cameras.height + row) * cameras.width + column
        pixels = informative_pixels(candidates.to(device), _NUM_PIXELS, photographed, cameras)
        progress = step / max(steps - 1, 1)
        difference = _FIRST_DIFFERENCE * (_LAST_DIFFERENCE / _FIRST_DIFFERENCE) ** progress
        settings = Step(difference, _ERROR_SCALE, _MAX_PIXELS)
        gauss_newton_step(camera, cameras, pixels, photographed, shown, settings)
    return camera.estimated(cameras).to(views.cameras.device)
