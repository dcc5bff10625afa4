"""Composition of models, and a volume of all space that learns a glass ball in a painted room."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.backgrounds.base import Background, ConstantBackground
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.compositing import composite
from nerfro.core.draws import Draws
from nerfro.core.types import Exits, Path
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.space import Box, Contracted, Space
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.nerf import MipNerfModel
from nerfro.rendering import Components
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import example_rays
from tests.cameras_at import cameras_at
from tests.closed_forms import Ball
from tests.paper import small_components
from tests.reference_tracer import Snell

WALL = 3.0  # half side of the room
TOY, SIZE = torch.tensor([0.3, 1.2, 0.2]), 0.3
SPACE = Contracted([[-1.0] * 3, [1.0] * 3], 2.0, near=0.3)


def seen(path: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """What all paths end on, walls painted by place or the toy, and whether it is the toy."""
    colour, toy = torch.full((len(path.s), 3), torch.nan), torch.zeros(len(path.s)).bool()
    for run in range(path.s.shape[1]):
        origin, direction = path.positions[:, run], path.directions[:, run]
        last = run == path.s.shape[1] - 1
        length = torch.full_like(path.s[:, 0], torch.inf) if last else path.s[:, run + 1] - path.s[:, run]
        along = ((TOY - origin) * direction).sum(-1)
        root = SIZE**2 - (origin + along[:, None] * direction - TOY).square().sum(-1)
        to_toy = along - root.clamp(min=0).sqrt()
        to_wall = torch.where(direction > 0, (WALL - origin) / direction, (-WALL - origin) / direction).amin(-1)
        open_ = colour.isnan().any(-1)
        on_toy = open_ & (root > 0) & (to_toy > 0) & (to_toy < length)
        on_wall = open_ & ~on_toy & (to_wall < length)
        places = origin + to_wall[:, None] * direction
        painted = 0.5 + 0.4 * torch.sin(1.7 * places + torch.tensor([0.0, 1.0, 2.0]))
        colour = torch.where(on_wall[:, None], painted, colour)
        colour = torch.where(on_toy[:, None], torch.tensor([0.9, 0.1, 0.1]), colour)
        toy = toy | on_toy
    return colour, toy


def photographs(num_views: int, seed: int) -> tuple[Path, torch.Tensor, torch.Tensor]:
    """Paths and colours of all pixels of cameras around the ball."""
    generator = torch.Generator().manual_seed(seed)
    back = normalize(torch.randn(num_views, 3, generator=generator), dim=-1)
    right = normalize(torch.linalg.cross(torch.randn(num_views, 3, generator=generator), back), dim=-1)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, 2.2 * back], -1)
    cameras = cameras_at(pose, 24, 24, 17.5, near=0.1, far=5.0)
    view, row, column = torch.cartesian_prod(torch.arange(num_views), torch.arange(24), torch.arange(24)).unbind(-1)
    path = Snell()(cameras.rays(view, row, column), Ball(radius=0.8))
    return path, *seen(path)


def rendered(
    path: Path, sampler: DensityGridSampler, field: HashGridField, background: Background, draws: Draws | None = None
) -> torch.Tensor:
    samples = sampler(path, None, draws)
    return composite(samples, field(samples), background(path.exits()), path).radiance


def scores(space: Space, background: Background, num_steps: int = 150) -> list[float]:
    """PSNR of unseen views: of all pixels, of those behind glass, of those that see the toy."""
    path, target, _ = photographs(24, 1)
    field = HashGridField(
        space, num_levels=6, finest_resolution=64, log2_table_size=14, width=32, initial_depth=3.0,
        direction_bands=1,
    )  # fmt: skip
    sampler = DensityGridSampler(space, 24, 48, resolution=32, update_every=4, decay=0.6)
    parameters = [*field.parameters(), *background.parameters()]
    optimizer = torch.optim.Adam(parameters, eps=1e-15)
    for step in range(num_steps):
        draws = Draws(0, step, torch.arange(512))
        sampler.update([field], draws)
        optimizer.param_groups[0]["lr"] = 4e-2 * 0.1 ** (step / num_steps)
        chosen = torch.randint(len(target), (512,))
        loss = (rendered(path[chosen], sampler, field, background, draws) - target[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    path, target, toy = photographs(3, 2)
    with torch.no_grad():
        error = (rendered(path, sampler, field, background) - target).square().mean(-1)
    return [float(-10 * torch.log10(e.mean())) for e in (error, error[path.refracted], error[toy])]


@pytest.mark.slow
def test_volume_of_all_space_learns_a_room_better_than_box_and_environment_map() -> None:
    volume = scores(SPACE, ConstantBackground([0.0, 0.0, 0.0]))
    sky = scores(Box([[-0.85] * 3, [0.85] * 3]), EnvironmentMap([4, 8, 16, 32]))
    assert volume[0] > sky[0] + 6
    assert volume[1] > sky[1] + 5, "behind the glass"
    assert volume[2] > sky[2] + 5, "a box holds what is in it, and the toy stands before it"


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
