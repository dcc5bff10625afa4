"""The plugin that holds Eikonal Fields: its medium, paths and stages, and the index of a ball learned from images."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from nerfro.backgrounds.base import ConstantBackground
from nerfro.core.types import FieldValues, Samples
from nerfro.data.base import Views
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.files.images import save_png
from nerfro.geometry.space import Box
from nerfro.media.base import Medium
from nerfro.optimizers.config import OptimizerConfig
from nerfro.paper.eikonal import Eikonal
from nerfro.paper.nerf import NerfField
from nerfro.registry.registration import discover, find
from nerfro.rendering import Components, Renderer
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import example_rays
from nerfro.training.config import build_model
from nerfro.training.module import TrainingModule
from nerfro.training.run_folder import load_checkpoint, restore
from tests.ball_photographs import save
from tests.closed_forms import Ball
from tests.conftest import QUIET, Runner, refused
from tests.exact_silhouettes import cameras_around

discover()
IndexField = find("medium", "index_field").cls
BoxMarch = find("sampler/path", "box_march").cls
EikonalFields = find("model", "eikonal_fields").cls

SCENE, INDEX, INTERIOR = 0, 1, 2


def random_index_field(**fields: Any) -> Medium:
    """An index field as it may be in the middle of training, in double precision."""
    medium = IndexField(**{"width": 16, "depth": 3, "skip": 2, "octaves": 3, **fields})
    torch.nn.init.normal_(medium.last.weight, std=0.2)
    return medium.double()


# The medium.


def test_gradient_is_the_derivative_of_the_index_within_the_bounds() -> None:
    medium = random_index_field()
    positions = (torch.rand(50, 3, dtype=torch.float64) * 2 - 1).requires_grad_()
    n, gradient = medium(positions)
    (expected,) = torch.autograd.grad(n.sum(), positions)
    assert gradient.abs().max() > 0.05
    torch.testing.assert_close(gradient, expected)


def test_index_and_gradient_vanish_continuously_at_the_box() -> None:
    medium = random_index_field()
    face = medium.box[1, 0] * torch.tensor([1 - 1e-6, 0.2, 0.3], dtype=torch.float64)
    n, gradient = medium(torch.stack([face, face * torch.tensor([1 + 2e-6, 1, 1], dtype=torch.float64)]))
    torch.testing.assert_close(n, torch.ones_like(n), atol=1e-6, rtol=0)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), atol=1e-6, rtol=0)


def test_bounds_are_those_of_the_mesh(tiny_scene: Path) -> None:
    medium = IndexField(mesh=str(tiny_scene / "mesh.ply"), margin=0.25)
    torch.testing.assert_close(medium.content_box, torch.tensor([[-0.6] * 3, [0.6] * 3]), atol=1e-2, rtol=0)
    assert float(medium.box[1, 0] - medium.content_box[1, 0]) == pytest.approx(0.3, abs=1e-2)


# Paths.


def test_gradients_of_exit_directions_are_those_of_finite_differences() -> None:
    rays = example_rays(6)
    rays = replace(rays, **{name: getattr(rays, name).double() for name in ("origins", "directions", "near", "far")})
    medium = random_index_field()
    weight = medium.layers[0].weight
    toward = torch.randn(6, 3, dtype=torch.float64)

    def value() -> Tensor:
        return (BoxMarch(24)(rays, medium).exit_directions * toward).sum()

    value().backward()
    step = 1e-6
    for row, column in ((0, 1), (3, 4), (7, 0)):
        with torch.no_grad():
            weight[row, column] += step
            above = value()
            weight[row, column] -= 2 * step
            below = value()
            weight[row, column] += step
        assert float(weight.grad[row, column]) == pytest.approx(float(above - below) / (2 * step), rel=1e-4, abs=1e-9)


# The model.


class Slanted(Field):
    """Density 1 and a colour that grows with x, everywhere."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(0.1))

    def forward(self, samples: Samples) -> FieldValues:
        return FieldValues(torch.ones_like(samples.s), 0.5 + self.scale * samples.positions)


def make_model(make_field: Callable[[], Field] = Slanted, **fields: Any) -> Renderer:
    parts = Components(
        medium=IndexField(width=8, depth=2, skip=0),
        path_sampler=BoxMarch(16),
        point_sampler=Stratified(64),
        make_field=make_field,
        background=ConstantBackground([0.2, 0.3, 0.4]),
        space=Box([[-5.0] * 3, [5.0] * 3]),
    )
    return EikonalFields(parts, **{"resolution": 16, **fields})


def test_stages_split_the_budget() -> None:
    model = make_model(scene_fraction=0.5, index_fraction=0.3)
    stages = [model.stage_at(progress) for progress in (0.0, 0.25, 0.5, 0.65, 0.9, 1.0)]
    assert [int(stage) for stage, _ in stages] == [SCENE, SCENE, INDEX, INDEX, INTERIOR, INTERIOR]
    assert [done for _, done in stages] == pytest.approx([0, 0.5, 0, 0.5, 0.5, 1])


def test_each_stage_trains_its_own_parameters() -> None:
    model = make_model(lambda: NerfField(width=8, depth=2, skip=1, view_width=8))
    torch.nn.init.normal_(model.scene.medium.last.weight, std=0.2)
    model.train()
    trained = {}
    for stage in (SCENE, INDEX, INTERIOR):
        model.stage.fill_(stage)
        model.sharpen(0)
        model.zero_grad(set_to_none=True)
        model(example_rays())[-1].radiance.sum().backward()
        parts = {"scene": model.scene.fields, "index": model.scene.medium, "interior": model.interior}
        trained[stage] = {name for name, part in parts.items() if any(p.grad is not None for p in part.parameters())}
    assert trained == {SCENE: {"scene"}, INDEX: {"index"}, INTERIOR: {"interior"}}


def test_content_of_the_first_stage_inside_the_box_is_discarded() -> None:
    rays = example_rays()
    model = make_model().eval()
    first = model(rays)[-1]
    model.stage.fill_(INDEX)
    second = model(rays)[-1]
    inside = (first.samples.positions.abs() <= model.scene.medium.box[1]).all(-1)
    assert inside.any()
    assert bool((second.weights[inside] == 0).all())
    # Before the box nothing has changed.
    before = (inside.cumsum(-1) == 0) & inside.any(-1, keepdim=True)
    torch.testing.assert_close(first.weights[before], second.weights[before])


def test_several_processes_are_refused_before_training() -> None:
    module = TrainingModule(make_model(), {}, OptimizerConfig())
    module.trainer = SimpleNamespace(world_size=1, datamodule=object())  # type: ignore[assignment]
    module.setup("fit")
    module.trainer = SimpleNamespace(world_size=2, datamodule=object())  # type: ignore[assignment]
    refused("trains in one process", module.setup, "fit")


# All of it, from the command line.


# The index of a ball.

RADIUS, SHELL, IOR = 0.6, 0.2, 1.33


@pytest.mark.slow
def test_index_of_a_homogeneous_ball_is_recovered(train_here: Runner, tmp_path: Path) -> None:
    """From twelve images of 20x20 pixels before a known sky, from n = 1 on, within 2 %.

    The ball's surface is a shell in which the index rises smoothly, because a smooth field cannot be sharp.
    """
    save(ball_scene(), tmp_path / "ball")
    save_png(tmp_path / "sky.png", ball_sky(lat_long.directions(128)))
    side = RADIUS + SHELL
    train_here(
        "+experiment=eikonal_fields",
        f"data.root={tmp_path / 'ball'}",
        *QUIET,
        "sampler.points.num_samples=16",
        "field.num_levels=4",
        "field.log2_table_size=10",
        "evaluation.subdivision.side=1",
        "evaluation.every=0",
        "medium={mesh: null, width: 24, depth: 3, octaves: 3}",
        f"medium.box_min=[-{side},-{side},-{side}]",
        f"medium.box_max=[{side},{side},{side}]",
        "data.near=2",
        "data.far=6",
        "evaluation.split=train",
        "sampler.path.num_steps=24",
        "background.resolutions=[64]",
        f"background.image={tmp_path / 'sky.png'}",
        "optimizer={learning_rate: 1e-2, final_learning_rate: 1e-3, groups: {background.*: {learning_rate: 1e-9}}}",
        "model={resolution: 64, blur: 1.5, num_levels: 3, scene_fraction: 0.003, index_fraction: 0.997}",
        "batches.size=200",
        "trainer.max_steps=150",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
    checkpoint, config = load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    untrained = build_model(OmegaConf.create(config))
    assert float(untrained.scene.medium.last.weight.detach().abs().max()) == 0  # it begins without a ball
    model = restore(checkpoint, config)
    directions = torch.nn.functional.normalize(torch.randn(1000, 3), dim=-1)
    inside = directions * (RADIUS - SHELL) * torch.rand(1000, 1) ** (1 / 3)
    with torch.no_grad():
        n, _ = model.scene.medium(inside)
    assert float(n.mean()) == pytest.approx(IOR, rel=0.02)
    assert float(n.std()) < 0.02 * IOR


def ball_sky(directions: Tensor) -> Tensor:
    """A sky of a few waves of different lengths, as a function of direction."""
    waves = torch.tensor([[2.0, 1.0, 0.4], [-0.6, 2.0, 1.2], [0.8, -1.2, 2.0]])
    colour = 0.5 + 0.16 * torch.sin(directions @ waves.T)
    colour += 0.12 * torch.cos(2.3 * directions @ waves.flip(0).T)
    return colour + 0.1 * torch.sin(5 * directions @ waves.roll(1, 0).T)


def ball_scene() -> Views:
    """Photographs of a ball before `ball_sky`."""
    cameras = cameras_around(12, 20, distance=3.0, focal=2.5)
    images = []
    for view in range(len(cameras)):
        path = Eikonal()(cameras.image_rays(view), Ball(RADIUS, IOR, SHELL))
        images.append(ball_sky(path.exit_directions).view(20, 20, 3))
    return Views(cameras, torch.stack(images), None, [str(view) for view in range(len(cameras))])
