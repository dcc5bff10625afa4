"""Gains of photographs: nothing on average, seen by every loss."""

import pytest
import torch
from torch.nn.functional import mse_loss

from nerfro.camera.exposure import Exposure, fit_gain
from nerfro.core.light import to_srgb
from nerfro.losses.radiance import Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.testing import NUM_RAYS, example_batch, example_components


def test_gains_have_a_mean_of_one() -> None:
    exposure = Exposure()
    exposure.begin(5)
    assert torch.equal(exposure.gains(), torch.ones(5, 3))
    torch.nn.init.normal_(exposure.log_gain, mean=3.0)
    torch.testing.assert_close(exposure.gains().log().mean(0), torch.zeros(3), rtol=0, atol=1e-6)


def test_gains_are_fitted_to_unsaturated_pixels() -> None:
    exposure, gains = Exposure(), torch.ones(5, 3)
    gains[:2] = torch.tensor([[0.5, 1.0, 2.0], [2.0, 1.0, 0.5]])
    exposure.begin(5)  # without a pixel of the last view
    view, radiance = torch.arange(400) % 4, 0.9 * torch.rand(400, 3)
    photographed = (gains[view] * radiance).clamp(max=1)
    photographed[view == 2] = 0  # a black photograph has no gain
    exposure.fit(view, radiance, photographed)
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
