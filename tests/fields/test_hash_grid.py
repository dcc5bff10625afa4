"""The hash-grid field and its evaluation of selected samples."""

from dataclasses import replace

import pytest
import torch

from nerfro.core.types import Samples
from nerfro.fields.base import evaluate_selected
from nerfro.fields.hash_encoding import hash_encode_in_torch
from nerfro.fields.hash_grid import HashGridField
from nerfro.fields.spherical_harmonics import spherical_harmonics_in_torch
from nerfro.geometry.space import Box, Contracted, Space, inside_box
from tests.exact_silhouettes import cameras_around


def make_samples(num_rays: int = 6, num_samples: int = 9, scale: float = 2.0) -> Samples:
    generator = torch.Generator().manual_seed(0)
    positions = scale * (2 * torch.rand(num_rays, num_samples, 3, generator=generator) - 1)
    directions = torch.nn.functional.normalize(torch.randn(num_rays, num_samples, 3, generator=generator), dim=-1)
    edges = torch.linspace(0, 1, num_samples + 1).expand(num_rays, -1)
    return Samples(positions, directions, edges[:, :-1], edges, torch.ones(num_rays))


CUBE = Box([[-1.0] * 3, [1.0] * 3])


def make_field(space: Space = CUBE, precision: str = "float32", **changes: object) -> HashGridField:
    torch.manual_seed(0)
    settings = {"num_levels": 4, "finest_resolution": 32, "log2_table_size": 10, "precision": precision} | changes
    field = HashGridField(space, **settings)
    torch.nn.init.normal_(field.table, std=0.5)
    return field


def test_selection_does_not_change_the_values_of_samples() -> None:
    samples = make_samples()
    selected = torch.rand(6, 9, generator=torch.Generator().manual_seed(4)) < 0.4
    asked = []

    def decoder(positions: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(positions.shape[0])
        return positions.square().sum(-1), directions.abs()

    values = evaluate_selected(decoder, samples, selected)
    density, colour = decoder(samples.positions, samples.directions)
    assert asked[0] == int(selected.sum())
    assert torch.equal(values.density, torch.where(selected, density, 0))
    assert torch.equal(values.radiance, torch.where(selected[..., None], colour, 0))


def test_empty_selection_has_gradients() -> None:
    field = make_field()
    values = field(make_samples(scale=0.0))  # all in the middle
    assert (values.density > 0).all()
    outside = make_samples()
    outside = Samples(outside.positions + 100, outside.directions, outside.s, outside.edges, outside.radii)
    values = field(outside)
    assert not values.density.any()
    assert not values.radiance.any()
    (values.density.sum() + values.radiance.sum()).backward()
    assert all(p.grad is not None and not p.grad.any() for p in field.parameters())


def test_only_samples_inside_the_box_are_evaluated() -> None:
    field, samples = make_field(Box([[-1, -0.5, 0], [1, 0.5, 1.5]])), make_samples()
    inside = inside_box(samples.positions, *field.bounds)
    assert 0 < inside.sum() < inside.numel()
    values = field(samples)
    assert torch.equal(values.density > 0, inside)


@pytest.mark.parametrize("space", [Box([[-2] * 3, [2] * 3]), Contracted([[-2] * 3, [2] * 3], 3.0)])
def test_only_occupied_samples_are_evaluated_in_images(space: Space) -> None:
    field, samples = make_field(space).eval(), make_samples()
    occupied = torch.rand(6, 9, generator=torch.Generator().manual_seed(5)) < 0.4
    whole, part = field(samples), field(replace(samples, occupied=occupied))
    assert (whole.density > 0).all()
    torch.testing.assert_close(part.density, torch.where(occupied, whole.density, 0))
    torch.testing.assert_close(part.radiance, torch.where(occupied[..., None], whole.radiance, 0))


def decoded_in_double(
    field: HashGridField, positions: torch.Tensor, directions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Density and colour by plain PyTorch in double precision."""
    unit = (positions - field.space.box[0]) / field.space.side
    plain = torch.nn.Sequential.forward  # the layers of ReluMLP, without its kernel in single precision
    encoded = hash_encode_in_torch(unit, field.table.double(), field.levels.resolutions, field.levels.sizes)
    geometry = plain(field.density_mlp.double(), encoded)
    inputs = torch.cat([geometry, spherical_harmonics_in_torch(directions, field.direction_bands)], -1)
    raw = plain(field.colour_mlp.double(), inputs) + geometry[:, 1:4]
    return field.initial_density * geometry[:, 0].exp(), torch.sigmoid(raw).square()


def test_gradients_of_positions_and_directions_match_autograd() -> None:
    inputs = [values.requires_grad_() for values in (torch.rand(80, 3) * 3 - 1.5, torch.randn(80, 3))]
    upstream = torch.tensor([1.0, -2.0, 3.0])
    field = make_field()
    field.colour_mlp[-1].weight.data *= 0.3  # no colour so dark that its gradient is held back
    edges = torch.tensor([[0.0, 1.0]]).expand(80, 2)
    samples = Samples(*(values[:, None] for values in inputs), edges[:, :1], edges, edges[:, 0])
    values = field(samples)
    ours = torch.autograd.grad(values.density.sum() + (values.radiance * upstream).sum(), inputs)
    in_double = [values.detach().double().requires_grad_() for values in inputs]
    density, colour = decoded_in_double(field, *in_double)
    expected = torch.autograd.grad(density.sum() + (colour * upstream).sum(), in_double)
    inside = inside_box(inputs[0], *field.bounds)
    assert 10 < inside.sum() < 70
    for found, reference in zip(ours, expected, strict=True):
        assert not found[~inside].any()
        torch.testing.assert_close(found[inside].double(), reference[inside], rtol=1e-3, atol=1e-4)
    few = [values[inside][:5].detach().requires_grad_() for values in in_double]
    assert torch.autograd.gradcheck(lambda p, d: decoded_in_double(field, p, d), few)


def test_shortcut_keeps_gradients_of_a_dead_colour_network() -> None:
    for shortcut in (False, True):
        field = make_field(shortcut=shortcut)
        with torch.no_grad():  # all units below zero in the first layer, wherever it is asked
            field.colour_mlp[0].weight[:] = 0
            field.colour_mlp[0].weight[:, 16] = -1  # the first harmonic is the same in all directions
        radiance = field(make_samples(scale=1.0)).radiance
        radiance.square().sum().backward()
        assert (field.table.grad.abs().sum() > 0) == shortcut
        assert bool(radiance.std(dim=(0, 1)).gt(1e-3).all()) == shortcut  # one grey everywhere without it


def test_field_runs_under_autocast_with_encodings_in_single_precision() -> None:
    field = make_field()
    with torch.autocast("cpu", torch.bfloat16):
        assert field.encode(torch.zeros(5, 3)).dtype == torch.float32
        values = field(make_samples())
    assert values.density.dtype == torch.float32
    values.density.sum().backward()
    assert field.table.grad is not None
    assert field.table.grad.dtype == torch.float32


def test_untrained_field_is_almost_transparent_in_any_box() -> None:
    for side in (0.1, 20.0):
        torch.manual_seed(0)
        field = HashGridField(Box([[0.0] * 3, [side] * 3]), initial_depth=0.2)
        with torch.no_grad():
            density, _ = field.decode(side * torch.rand(100, 3), torch.tensor([[0.0, 0, 1]]).expand(100, 3))
        torch.testing.assert_close(density * side, torch.full((100,), 0.2), rtol=0.02, atol=0)


def test_field_of_all_space_is_evaluated_at_contracted_positions() -> None:
    space = Contracted([[-0.5, 0.0, 0.5], [0.5, 1.0, 1.5]], 0.8)
    everywhere, samples = make_field(space), make_samples(scale=5.0)
    centre, positions = torch.tensor([0.0, 0.5, 1.0]), samples.positions.flatten(0, 1)
    offset = positions - centre
    within = offset.norm(dim=-1) < 0.8
    assert 0 < within.sum() < len(within)
    values = everywhere(samples)
    density, colour = everywhere.decode(space.contract(positions), samples.directions.flatten(0, 1))
    torch.testing.assert_close(values.radiance.flatten(0, 1), colour)
    found = values.density.flatten()
    torch.testing.assert_close(found[within], density[within])
    torch.testing.assert_close(found[~within], (density * (0.8 / offset.norm(dim=-1)) ** 2)[~within])
    assert (found > 0).all()


@pytest.mark.parametrize(("num_cameras", "needed"), [(12, 3), (1, 1)])
def test_space_close_to_a_camera_is_empty_unless_three_cameras_see_it(num_cameras: int, needed: int) -> None:
    cameras = cameras_around(num_cameras, 16)
    space = Contracted([[-1.0] * 3, [1.0] * 3], 2.0)
    field, whole = make_field(space), make_field(space)
    field.begin(cameras)
    cells = torch.randint(64, (20_000, 3), generator=torch.Generator().manual_seed(0))
    points = space.expand(-4 + (cells + 0.5) / 8)
    offset = points - cameras.camera_to_world[:, None, :, 3]
    right, up, back = (offset @ cameras.camera_to_world[:, :, :3]).unbind(-1)
    seen = torch.maximum(right.abs(), up.abs()) * 2 * 1.4 < -back  # a focal length of 1.4 image sides
    empty = (offset.norm(dim=-1) < 2).any(0) & (seen.sum(0) < needed)
    assert 100 < empty.sum() < 10_000
    samples = Samples(points[:, None], points[:, None], *[torch.zeros(len(points), n) for n in (1, 2)], points[:, 0])
    for found, expected in (
        (field.density(points), whole.density(points)),
        (field(samples).density[:, 0], whole(samples).density[:, 0]),
    ):
        assert torch.equal(found, torch.where(empty, 0, expected))
