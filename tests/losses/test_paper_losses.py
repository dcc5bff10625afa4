"""The paper's losses: their values by hand, what their gradients reach, and the schedule of their weights."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from nerfro.boundaries.skybox import Skybox
from nerfro.errors import NerfroError
from nerfro.fields.nerf import NerfField
from nerfro.losses.boundary import BoundaryRegulariser
from nerfro.losses.photometric import Photometric
from nerfro.losses.smoothness import Smoothness, tile_roughness
from nerfro.models.refractive import RefractiveModel
from nerfro.registry import create, find
from nerfro.rendering import Components, Renderer
from nerfro.samplers.eikonal import Eikonal
from nerfro.samplers.hierarchical import Hierarchical
from nerfro.testing import NUM_RAYS, example_batch, example_rendering
from tests.closed_forms import Luneburg


@pytest.fixture(scope="module")
def model() -> Renderer:
    parts = Components(
        medium=Luneburg(),
        path_sampler=Eikonal("euler", 32),
        point_sampler=Hierarchical(8, 8),
        make_field=lambda: NerfField(width=16, depth=2, skip=1, view_width=8),
        boundary=Skybox(width=8),
    )
    return RefractiveModel(parts, colour="srgb")


def gradient_norms(model: Renderer, value: Tensor) -> dict[str, float]:
    model.zero_grad()
    value.backward()
    parts = {"coarse": model.scene.fields[0], "fine": model.scene.fields[1], "boundary": model.scene.boundary}
    return {
        name: sum(float(p.grad.abs().sum()) for p in part.parameters() if p.grad is not None)
        for name, part in parts.items()
    }


def test_photometric_loss_is_the_mean_over_rays_and_channels_of_both_levels(model: Renderer) -> None:
    batch = example_batch()
    coarse = replace(example_rendering(), rgb=batch.rgb + 0.1)
    fine = replace(coarse, rgb=batch.rgb - 0.3)
    torch.testing.assert_close(Photometric()([coarse, fine], batch, model.scene), torch.tensor(0.09 + 0.01))
    torch.testing.assert_close(Photometric(coarse=0.1)([coarse, fine], batch, model.scene), torch.tensor(0.09 + 0.001))


def test_photometric_loss_reaches_both_fields_and_the_boundary(model: Renderer) -> None:
    batch = example_batch()
    norms = gradient_norms(model, Photometric()(model(batch.rays), batch, model.scene))
    assert min(norms.values()) > 0


def test_boundary_regulariser_by_hand(model: Renderer) -> None:
    batch = example_batch()
    transmittance = torch.linspace(0, 1, NUM_RAYS)
    rendering = replace(example_rendering(), transmittance=transmittance)
    total, count = 0.0, 0
    for ray in range(NUM_RAYS):
        if transmittance[ray] > 0.5:
            count += 1
            passed = transmittance[ray] * rendering.boundary_rgb[ray]
            total += sum(abs(float(passed[c] - batch.rgb[ray, c])) for c in range(3))
    value = BoundaryRegulariser()([rendering, rendering], batch, model.scene)
    assert value.item() == pytest.approx(total / (count + 1), rel=1e-5)


def test_boundary_regulariser_can_be_restricted_to_refracted_rays(model: Renderer) -> None:
    batch = example_batch()
    rendering = replace(example_rendering(), transmittance=torch.ones(NUM_RAYS))
    refracted = rendering.path.refracted
    assert 0 < refracted.sum() < NUM_RAYS
    error = (rendering.boundary_rgb - batch.rgb).abs().sum(-1)[refracted]
    value = BoundaryRegulariser(refracted_only=True)([rendering], batch, model.scene)
    torch.testing.assert_close(value, error.sum() / (len(error) + 1))


def test_boundary_regulariser_teaches_the_fine_density_only(model: Renderer) -> None:
    with torch.no_grad():
        for field in model.scene.fields:
            field.mlp.density.bias.fill_(-3.0)  # thin enough for light to pass
    batch = example_batch()
    renderings = model(batch.rays)
    assert (renderings[-1].transmittance > 0.5).any()
    norms = gradient_norms(model, BoundaryRegulariser()(renderings, batch, model.scene))
    assert norms["coarse"] == norms["boundary"] == 0
    assert norms["fine"] > 0
    colour = model.scene.fields[1].mlp.rgb
    assert colour.weight.grad is None or (colour.weight.grad == 0).all()


def test_roughness_is_half_the_mean_square_of_two_convolutions() -> None:
    rgb = torch.rand(9, 7, 3)
    channels = rgb.movedim(-1, 0)[:, None]
    horizontal = conv2d(channels, torch.tensor([[[[-1.0, 1.0]]]]))
    vertical = conv2d(channels, torch.tensor([[[[-1.0], [1.0]]]]))
    expected = 0.5 * horizontal.square().mean() + 0.5 * vertical.square().mean()
    torch.testing.assert_close(tile_roughness(rgb), expected)


def test_smoothness_teaches_the_boundary_only(model: Renderer) -> None:
    batch = example_batch()
    norms = gradient_norms(model, Smoothness(tile_size=8)(model(batch.rays), batch, model.scene))
    assert norms["coarse"] == norms["fine"] == 0
    assert norms["boundary"] > 0


def test_weight_is_zero_before_the_start_then_grows_linearly_to_its_value() -> None:
    loss = create(find("loss", "photometric"), {"weight": 2.0, "start": 10, "ramp": 4})
    assert [loss.weight_at(step) for step in (0, 9)] == [0, 0]
    torch.testing.assert_close(
        torch.tensor([loss.weight_at(step) for step in range(10, 16)]), torch.tensor([0.4, 0.8, 1.2, 1.6, 2.0, 2.0])
    )


@pytest.mark.parametrize("option", ["weight", "start", "ramp"])
def test_negative_schedules_are_refused(option: str) -> None:
    with pytest.raises(NerfroError, match=f"{option}=-1.* is not allowed; take at least 0"):
        create(find("loss", "photometric"), {option: -1})


def test_tile_without_neighbours_is_refused() -> None:
    with pytest.raises(NerfroError, match="tile_size=1 is not allowed; take at least 2"):
        Smoothness(tile_size=1)
