"""Addition of light: transfer function, polylines of a ray, radiance of pixels, and learned parameters."""

from dataclasses import replace
from pathlib import Path as FilePath

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.compositing import composite
from nerfro.core.light import to_linear, to_srgb
from nerfro.core.types import Exits, FieldValues, Path
from nerfro.files import lat_long
from nerfro.losses.base import Loss
from nerfro.losses.terms import BackgroundRegularizer, Distortion, Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.optimizers.config import GroupConfig, OptimizerConfig
from nerfro.paper.hierarchical import Hierarchical
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import (
    NUM_RAYS,
    example_batch,
    example_components,
    example_draws,
    example_path,
    example_rays,
    example_space,
)
from nerfro.training.module import TrainingModule


def split_path(of_straight: float) -> Path:
    """Two polylines for each example ray: bent by a ball, and straight on, which brings the given share."""
    both = Path.joined([replace(example_path(), record=None), straight_path(example_rays())])
    order = torch.stack([torch.arange(NUM_RAYS), torch.arange(NUM_RAYS) + NUM_RAYS], 1).flatten()
    share = torch.tensor([1 - of_straight, of_straight]).repeat(NUM_RAYS)
    ray = torch.arange(NUM_RAYS).repeat_interleave(2)
    return replace(both[order], splits=True, ray=ray, throughput=share[:, None].expand(-1, 3))


def rendered(path: Path) -> Tensor:
    model = RefractiveModel(replace(example_components(), background=EnvironmentMap([4]))).eval()
    torch.manual_seed(1)
    torch.nn.init.normal_(model.scene.background.texels)
    for parameter in model.scene.fields.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    with torch.no_grad():
        return model.render_path(path)[-1].radiance


def test_ray_is_the_sum_of_its_polylines_weighted_by_throughput() -> None:
    both = rendered(split_path(0.3))
    expected = 0.7 * rendered(example_path()) + 0.3 * rendered(straight_path(example_rays()))
    assert both.shape == (NUM_RAYS, 3)
    torch.testing.assert_close(both, expected)


def test_opacity_and_depth_belong_to_rays() -> None:
    path = split_path(0.25)
    samples = Stratified(8)(path, None)
    density = torch.zeros_like(samples.s)
    density[1::2] = 50.0  # the straight polylines are blocked at once, the bent ones pass
    rendering = composite(samples, FieldValues(density, samples.positions), torch.zeros(2 * NUM_RAYS, 3), path)
    torch.testing.assert_close(rendering.opacity, torch.full((NUM_RAYS,), 0.25))
    first = 0.5 * (samples.edges[1::2, 0] + samples.edges[1::2, 1])
    torch.testing.assert_close(rendering.depth, first, rtol=1e-3, atol=0)
    assert torch.equal(rendering.exit_directions, path.exit_directions[::2])


@pytest.mark.parametrize("sampler", [Stratified(8), Hierarchical(8, 8), DensityGridSampler(example_space(), 8, 16)])
def test_random_numbers_are_drawn_for_each_ray(sampler: Stratified | Hierarchical | DensityGridSampler) -> None:
    same = straight_path(example_rays())
    rows = torch.arange(NUM_RAYS).repeat_interleave(2)
    twice = replace(same[rows], splits=True, ray=rows)
    samples = sampler(twice, None, example_draws())
    assert torch.equal(samples.s[::2], samples.s[1::2]), "polylines of a ray share its numbers"
    assert torch.equal(samples.s[::2], sampler(same, None, example_draws()).s), "and splitting changes nobody's"


@pytest.mark.parametrize("loss", [Photometric(), BackgroundRegularizer(), Distortion()])
def test_losses_accept_rays_that_split(loss: Loss) -> None:
    model, batch = RefractiveModel(example_components()).eval(), example_batch()
    with torch.no_grad():
        bent = model.render_path(example_path())
        split = model.render_path(split_path(0.0))  # a second polyline that brings nothing
        assert loss([*split], batch, model.scene) == pytest.approx(float(loss([*bent], batch, model.scene)), rel=1e-5)


def test_samples_follow_the_gradients_of_their_path() -> None:
    path = example_path()
    positions = path.positions.clone().requires_grad_()
    moving = replace(path, positions=positions)
    for sampler in (Stratified(8), DensityGridSampler(example_space(), 8, 16)):
        samples = sampler(moving, None)
        assert not samples.s.requires_grad
        (gradient,) = torch.autograd.grad(samples.positions.sum(), positions)
        assert gradient.sum() == pytest.approx(samples.positions.numel(), rel=1e-4)
        torch.testing.assert_close(samples.positions.detach(), sampler(path, None).positions, atol=1e-5, rtol=0)


def test_exits_begin_at_the_last_straight_segment() -> None:
    path = example_path()
    exits = path.exits()
    straight = ~path.refracted
    torch.testing.assert_close(exits.positions[straight], path.positions[straight, 0])
    on_ball = exits.positions[path.refracted].norm(dim=-1)
    torch.testing.assert_close(on_ball, torch.full_like(on_ball, 0.8))
    assert torch.equal(exits.directions, path.exit_directions)


# --- linear radiance ---


def test_pixel_is_the_encoded_mean_of_radiance() -> None:
    one = torch.zeros(1, dtype=torch.long)
    batch = replace(
        example_batch(), maps={}, ray_pixel=one.expand(NUM_RAYS), pixel_number=one, view=one, rgb=torch.zeros(1, 3),
        teaches_background=torch.ones(1, dtype=torch.bool),
    )  # fmt: skip
    radiance = torch.zeros(NUM_RAYS, 3)
    radiance[::2] = 1
    assert float(to_srgb(batch.per_pixel(radiance))[0, 0]) == pytest.approx(0.7354, abs=1e-3)


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_bright_lights_of_a_sky_survive_a_file_and_a_texture(tmp_path: FilePath, suffix: str) -> None:
    sky = torch.full((32, 64, 3), 0.02)
    sky[8:16, 16:32] = torch.tensor([40.0, 25.0, 10.0])
    lat_long.save_lat_long(tmp_path / f"sky{suffix}", sky)
    # Radiance's mantissa of eight bits is shared by the channels.
    torch.testing.assert_close(lat_long.load_lat_long(tmp_path / f"sky{suffix}"), sky, rtol=0.02, atol=1e-3)
    background = EnvironmentMap([64], image=str(tmp_path / f"sky{suffix}"))
    lamp = lat_long.directions(32)[12, 24]
    torch.testing.assert_close(background(Exits(lamp[None]))[0], sky[12, 24], rtol=0.03, atol=0)
    radiance = background(Exits(lat_long.directions(32))).detach()
    lat_long.save_lat_long(tmp_path / f"again{suffix}", radiance)
    assert lat_long.load_lat_long(tmp_path / f"again{suffix}").max() > 35


def test_png_sky_is_decoded_and_encoded(tmp_path: FilePath) -> None:
    levels = torch.linspace(0, 1, 64).expand(32, 64)[..., None].expand(-1, -1, 3)
    lat_long.save_lat_long(tmp_path / "sky.png", to_linear(levels))
    torch.testing.assert_close(to_srgb(lat_long.load_lat_long(tmp_path / "sky.png")), levels, rtol=0, atol=1 / 400)


@pytest.mark.parametrize("num_channels", [1, 3])
def test_sky_of_16_bits_keeps_its_levels(tmp_path: FilePath, num_channels: int) -> None:
    levels = np.random.default_rng(0).integers(0, 65536, (4, 8, num_channels), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "sky.png"), levels[..., ::-1])
    expected = to_linear(torch.from_numpy(levels / 65535).float()).expand(-1, -1, 3)
    torch.testing.assert_close(lat_long.load_lat_long(tmp_path / "sky.png"), expected)


# --- what learns ---


def test_every_learned_parameter_has_a_group_and_a_learning_rate() -> None:
    model = RefractiveModel(example_components())
    assert all(name.startswith("fields.0.") for name in model.parameters_by_name())
    model.scene.medium.index = torch.nn.Parameter(torch.tensor(1.5))
    model.scene.camera.shift = torch.nn.Parameter(torch.zeros(3))
    rates = {"medium.*": GroupConfig(learning_rate=2e-2), "cameras.*": GroupConfig(learning_rate=3e-2)}
    optimizer = OptimizerConfig(learning_rate=1e-2, groups=rates)
    groups = TrainingModule(model, {}, optimizer).make_optimizer().param_groups
    assert [group["name"] for group in groups] == ["common", "medium.*", "cameras.*"]
    assert [group["initial_lr"] for group in groups] == [1e-2, 2e-2, 3e-2]
    assert sum(len(group["params"]) for group in groups) == len(list(model.parameters()))
    assert model.paths_learn


def test_srgb_curve_matches_the_standard() -> None:
    torch.testing.assert_close(to_linear(torch.tensor([0.0, 0.5, 1.0])), torch.tensor([0.0, 0.214041, 1.0]))


def test_encoding_undoes_decoding_with_finite_gradients() -> None:
    srgb = torch.linspace(0, 1, 256, requires_grad=True)
    linear = to_linear(srgb)
    torch.testing.assert_close(to_srgb(linear), srgb, rtol=0, atol=1e-6)
    to_srgb(linear).sum().backward()
    assert srgb.grad is not None
    assert srgb.grad.isfinite().all()


def test_arrays_are_encoded_like_tensors() -> None:
    values = np.linspace(0, 1.5, 24, dtype=np.float32).reshape(4, 6)[::-1]  # negative strides, as in flipped pictures
    for code in (to_linear, to_srgb):
        np.testing.assert_array_equal(code(values), code(torch.tensor(values.copy())).numpy())
        assert code(values).dtype == np.float32
    assert to_srgb(np.array(0.18)).shape == ()
