"""Composition of models: fields of each level, evaluation of the background, and rendering in chunks."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.types import Exits
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.nerf import MipNerfModel
from nerfro.rendering import Components
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import example_rays
from tests.paper import small_components


class Compass(Background):
    """Radiance is the direction."""

    def forward(self, exits: Exits) -> Tensor:
        return 0.5 + 0.5 * exits.directions


@pytest.fixture
def parts() -> Components:
    return replace(small_components(), chunk_size=7)


def test_refractive_model_has_a_field_for_each_level_and_mip_nerf_one_for_all(parts: Components) -> None:
    assert len(RefractiveModel(parts).scene.fields) == 2
    assert len(MipNerfModel(parts).scene.fields) == 1
    assert len(RefractiveModel(replace(parts, point_sampler=Stratified(8))).scene.fields) == 1


def test_background_is_evaluated_at_the_exit_or_at_the_last_coarse_sample(parts: Components) -> None:
    rays, parts = example_rays(), replace(parts, background=Compass())
    path = parts.path_sampler(rays, parts.medium)
    leaving = RefractiveModel(parts, "exit").eval()(rays)
    torch.testing.assert_close(leaving[-1].background_radiance, 0.5 + 0.5 * path.exit_directions)
    early = RefractiveModel(parts, "last_coarse").eval()(rays)
    for rendering in early:
        torch.testing.assert_close(rendering.background_radiance, 0.5 + 0.5 * early[0].samples.directions[:, -1])


@pytest.mark.parametrize("training", [True, False])
def test_rendering_uses_evaluation_mode_and_restores_the_mode(training: bool, parts: Components) -> None:
    model = RefractiveModel(parts).train(training)
    first, second = model.render(example_rays()), model.render(example_rays())
    assert torch.equal(first.radiance, second.radiance), "nothing random"
    assert model.training is training
    assert model.point_sampler.training is training
    assert not first.radiance.requires_grad


def test_chunk_size_bounds_the_number_of_rays_rendered_at_once(
    parts: Components, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, sizes = RefractiveModel(parts).eval(), []
    whole = model(example_rays())  # 24 rays
    forward = model.path_sampler.forward
    monkeypatch.setattr(
        model.path_sampler, "forward", lambda rays, medium: (sizes.append(len(rays)), forward(rays, medium))[1]
    )
    rendered = model.render(example_rays())
    assert sum(sizes) == 24
    assert max(sizes) <= 7  # several cores share the seven rays
    torch.testing.assert_close(rendered.radiance, whole[-1].radiance)
    none = model.render(example_rays()[:0])
    for name, values in vars(none).items():
        assert values.shape == (0, *getattr(rendered, name).shape[1:])
