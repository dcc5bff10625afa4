"""Gains of photographs: nothing on average, seen by every loss."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn.functional import mse_loss

from nerfro.camera.base import Appearance, Exposure, fit_gain
from nerfro.core.light import to_linear, to_srgb
from nerfro.evaluation.image_metrics import psnr
from nerfro.losses.terms import Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.testing import NUM_RAYS, example_batch, example_components
from nerfro.training.run_folder import load
from tests.ball_photographs import TRAINING, cameras, photographs, save
from tests.conftest import Runner


def test_gains_have_a_mean_of_one() -> None:
    exposure = Exposure()
    exposure.begin(cameras().select([0, 1, 2, 3, 4]))
    assert torch.equal(exposure.gains(), torch.ones(5, 3))
    torch.nn.init.normal_(exposure.log_gain, mean=3.0)
    torch.testing.assert_close(exposure.gains().log().mean(0), torch.zeros(3), rtol=0, atol=1e-6)


def test_gains_are_fitted_to_unsaturated_pixels() -> None:
    exposure, gains = Exposure(), torch.ones(5, 3)
    gains[:2] = torch.tensor([[0.5, 1.0, 2.0], [2.0, 1.0, 0.5]])
    exposure.begin(cameras().select([0, 1, 2, 3, 4]))  # without a pixel of the last view
    view, radiance = torch.arange(400) % 4, 0.9 * torch.rand(400, 3)
    photographed = (gains[view] * radiance).clamp(max=1)
    photographed[view == 2] = 0  # a black photograph has no gain
    exposure.fit(view, example_batch().rays, radiance, photographed)
    torch.testing.assert_close(exposure.gains(), gains)


def test_losses_use_exposed_renderings() -> None:
    model, batch = RefractiveModel(example_components()), example_batch()
    gain = torch.rand(NUM_RAYS, 3) + 0.5
    (rendering,) = model(batch.rays)
    exposed = rendering.exposed(gain)
    torch.testing.assert_close(exposed.radiance, gain * rendering.radiance)
    torch.testing.assert_close(exposed.background_radiance, gain * rendering.background_radiance)
    expected = mse_loss(model.scene.colour_space.to_srgb(gain * rendering.radiance), batch.rgb)
    torch.testing.assert_close(Photometric()([exposed], batch, model.scene), expected)


@pytest.mark.parametrize("factors", [(1.0, 1.0, 1.0), (0.4, 0.9, 1.7), (3.0, 0.2, 1.0)])
def test_fitted_gain_is_exact_despite_saturated_pixels(factors: tuple[float, ...]) -> None:
    radiance, gain = 1.5 * torch.rand(500, 3), torch.tensor(factors)
    found = fit_gain(
        RefractiveModel(example_components()).scene.colour_space.to_srgb,
        radiance,
        to_srgb(gain * radiance).clamp(max=1),
    )
    torch.testing.assert_close(found, gain, rtol=1e-4, atol=0)


def test_appearance_has_a_mean_of_one_at_each_position_in_the_image() -> None:
    taken, appearance = cameras().select([0, 1, 2, 3, 4]), Appearance(4)
    appearance.begin(taken)
    corner = [taken.image_rays(view)[:1] for view in range(5)]
    rays, views = type(corner[0]).joined(corner), torch.arange(5)
    assert torch.equal(appearance(views, rays), torch.ones(5, 3))
    torch.nn.init.normal_(appearance.embedding, mean=3.0)
    gains = appearance(views, rays)
    assert float(gains.detach().log().std()) > 0.1
    torch.testing.assert_close(gains.log().mean(0), torch.zeros(3), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_embeddings_explain_colour_casts_across_photographs_that_gains_do_not(
    train_here: Runner, tmp_path: Path
) -> None:
    """Each photograph is tinted along a direction of its own; other views keep the colours of the scene."""
    views = photographs([1.45])
    steps = torch.linspace(-1, 1, views.cameras.width)
    slopes = 0.4 * (2 * torch.rand(2, len(views), 1, 1, 3) - 1)
    casts = slopes[0] * steps[:, None] + slopes[1] * steps[:, None, None] - 0.8  # darker, so that nothing saturates
    save(replace(views, images=to_srgb(to_linear(views.images) * casts.exp())), tmp_path / "ball")
    clean, scores = to_srgb(to_linear(views.images) * casts.mean(0).exp()), {}
    for option in ("camera.exposure=true", "camera.appearance=8"):
        folder = tmp_path / option.partition("=")[0]
        options = [option, *TRAINING, "trainer.max_steps=300", f"data.root={tmp_path / 'ball'}"]
        train_here(*options, f"hydra.run.dir={folder}")
        scores[option] = float(psnr(load(folder).render(views.cameras).rgb.flatten(0, 1), clean.flatten(0, 1)))
    assert scores["camera.appearance=8"] > scores["camera.exposure=true"] + 3
