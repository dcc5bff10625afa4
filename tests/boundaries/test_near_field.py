"""Surroundings at finite distance: the geometry of contraction, and a room that no sky can explain."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn.functional import normalize

from nerfro.boundaries.base import Boundary
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.boundaries.near_field import NearField, _share, contract, contracted_lines, curve
from nerfro.cameras import Cameras
from nerfro.distributed import drawing_for
from nerfro.errors import NerfroError
from nerfro.fields import hash_encoding
from nerfro.fields.spherical_harmonics import spherical_harmonics
from nerfro.media.shapes import Ball
from nerfro.samplers.snell import Snell
from nerfro.samplers.straight import straight_path
from nerfro.types import Exits, Path, Radiance, Rays, Samples

SMALL = {
    "grid_resolution": 32,
    "num_levels": 6,
    "base_resolution": 8,
    "finest_resolution": 64,
    "log2_table_size": 14,
    "width": 32,
    "num_samples": 16,
    "num_bins": 32,
}
BOX = {"box_min": [-0.85] * 3, "box_max": [0.85] * 3}


@pytest.fixture
def near_field() -> NearField:
    return NearField(box_min=[-1.0, -0.5, 0.0], box_max=[1.0, 0.5, 3.0], radius=2.0, **SMALL).eval()


def rays(origins: list, directions: list, near: float = 0.5, far: float = 20.0) -> Rays:
    origin, direction = torch.tensor(origins), normalize(torch.tensor(directions), dim=-1)
    one = torch.ones(len(origin))
    return Rays(origin, direction, 0 * one, near * one, far * one)


def test_contraction_keeps_the_unit_ball_and_brings_infinity_to_two():
    x = torch.tensor([[0.3, -0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -4.0], [3e6, 4e6, 0.0]])
    expected = torch.tensor([[0.3, -0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.75], [1.2, 1.6, 0.0]])
    torch.testing.assert_close(contract(x), expected)


def test_lines_become_curves_in_contracted_space():
    offsets = torch.randn(50, 3) * torch.tensor([[0.5], [6.0]]).repeat(25, 1)
    directions = normalize(torch.randn(50, 3), dim=-1)
    path = contracted_lines(offsets, directions)
    torch.testing.assert_close(path.positions[:, 0], contract(offsets), rtol=0, atol=1e-5)
    torch.testing.assert_close(path.positions[:, -1], 2 * directions, rtol=0, atol=1e-4)
    assert (path.s.diff(dim=1) > 0).all()
    # Brought back to the world, places at all lengths lie on the line and in order.
    s = path.s[:, -1:] * torch.linspace(0, 0.97, 40)
    places = curve(offsets, directions, _share(path, s)).double()
    norm = places.norm(dim=-1, keepdim=True)
    places = torch.where(norm > 1, places / norm / (2 - norm), places)
    away = places - offsets.double()[:, None]
    line = directions.double()[:, None].expand_as(away)
    relative = torch.linalg.cross(away, line).norm(dim=-1) / (1 + places.norm(dim=-1))
    assert relative.max() < 1e-4  # single precision, far out
    assert ((away * line).sum(-1).diff(dim=1) > 0).all()
    # Lengths are those of the curve, as 2000 chords measure it.
    fine = curve(offsets, directions, torch.linspace(0, 1, 2001).expand(50, -1)).double()
    torch.testing.assert_close(fine.diff(dim=1).norm(dim=-1).sum(1).float(), path.s[:, -1], rtol=2e-3, atol=0)


def test_a_ray_through_the_box_is_seen_from_where_it_leaves_it(near_field):
    # Enters at z = 3 and leaves at z = 0, whatever lies before.
    down = straight_path(rays([[0.2, 0.1, 9.0]], [[0.0, 0.0, -1.0]]))
    nearer = straight_path(rays([[0.2, 0.1, 4.0]], [[0.0, 0.0, -1.0]]))
    colour = near_field(down.exits())
    torch.testing.assert_close(near_field(nearer.exits()), colour)
    expected = near_field._render(torch.tensor([[0.2, 0.1, 0.0]]), down.exit_directions)
    torch.testing.assert_close(colour, expected, rtol=0, atol=1e-5)


def test_a_ray_that_misses_the_box_is_seen_from_its_near_end(near_field):
    aside = straight_path(rays([[5.0, 0.0, 9.0]], [[0.0, 0.0, -1.0]], near=0.5))
    expected = near_field._render(torch.tensor([[5.0, 0.0, 8.5]]), aside.exit_directions)
    torch.testing.assert_close(near_field(aside.exits()), expected, rtol=0, atol=1e-5)


def test_by_direction_alone_it_is_seen_from_the_middle(near_field):
    directions = normalize(torch.randn(2, 4, 3), dim=-1)
    expected = near_field._render(torch.tensor([[0.0, 0.0, 1.5]]).expand(8, 3), directions.reshape(-1, 3))
    assert torch.equal(near_field(Exits(directions)), expected.view(2, 4, 3))


def test_a_sky_does_not_depend_on_the_place():
    sky = EnvironmentMap([4, 8])
    path = straight_path(rays([[5.0, 0.0, 9.0], [0.0, 1.0, 2.0]], [[0.0, 0.3, -1.0], [0.0, 0.3, -1.0]]))
    colours = sky(path.exits())
    assert torch.equal(colours, sky(Exits(path.exit_directions)))


class Cloud(nn.Module):
    """A smooth field in any precision."""

    def forward(self, samples: Samples) -> Radiance:
        x = samples.positions
        return Radiance(3 * torch.exp(-x.square().sum(-1)), torch.sigmoid(x * x.roll(1, -1) + samples.directions))


def kept(near_field: NearField, starts: torch.Tensor, directions: torch.Tensor) -> None:
    """Let its sampler choose the arc lengths of these lines, whatever it is asked later."""
    offsets = (starts - near_field.box.mean(0)) / near_field.radius
    chosen = near_field.sampler(contracted_lines(offsets, directions), None)
    near_field.sampler.forward = lambda path, previous: chosen


def some_lines(num: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.randn(num, 3) * torch.tensor([1.0, 0.5, 4.0]), normalize(torch.randn(num, 3), dim=-1)


def test_gradients_are_those_of_differences(near_field):
    starts, directions = some_lines(6)
    kept(near_field, starts, directions)
    near_field.double().field = Cloud()
    lines = (starts.double().requires_grad_(), directions.double().requires_grad_())
    assert torch.autograd.gradcheck(near_field._render, lines)


def test_kernels_pass_the_gradients_that_autograd_finds(near_field, monkeypatch):
    nn.init.normal_(near_field.field.table, std=0.5)
    near_field.field.precision = "float32"
    starts, directions = some_lines(40)
    kept(near_field, starts, directions)
    gradients = []
    for plain in (False, True):
        if plain:
            encode = hash_encoding.hash_encode
            monkeypatch.setattr("nerfro.fields.hash_encoding_cpu.hash_encode", encode)
            monkeypatch.setattr("nerfro.fields.spherical_harmonics_cpu.spherical_harmonics", spherical_harmonics)
        lines = (starts.clone().requires_grad_(), directions.clone().requires_grad_())
        colours = (near_field._render(*lines) * torch.tensor([1.0, -2.0, 3.0])).sum()
        gradients.append(torch.autograd.grad(colours, lines))
    for ours, reference in zip(*gradients, strict=True):
        assert reference.abs().max() > 0.01
        torch.testing.assert_close(ours, reference, rtol=1e-3, atol=1e-4 * float(reference.abs().max()))


def test_lines_through_the_box_pass_gradients_to_where_they_leave_it(near_field, monkeypatch):
    near_field.double()
    monkeypatch.setattr(near_field, "_render", lambda starts, directions, ray: starts)
    starts = torch.tensor([[0.2, 0.1, 9.0], [0.9, 0.2, 1.0], [5.0, 0.0, 9.0]], dtype=torch.float64)
    # One is parallel to four faces, one begins inside and one misses.
    directions = normalize(torch.tensor([[0.0, 0.0, -1.0], [0.3, 0.2, -0.5], [0.1, 0.0, -1.0]]).double(), dim=-1)
    lines = directions.requires_grad_(), starts.requires_grad_()
    assert torch.autograd.gradcheck(lambda d, x: near_field(Exits(d, x)), lines)


def test_polylines_of_a_ray_share_its_random_numbers(near_field):
    nn.init.normal_(near_field.field.table)
    near_field.train()
    path = straight_path(rays([[0.2, 0.1, 9.0], [5.0, 0.0, 9.0]], [[0.0, 0.3, -1.0]] * 2))
    split = replace(path[torch.tensor([0, 0, 1])], ray=torch.tensor([0, 0, 1]))
    colours = []
    for exits in (path.exits(), split.exits()):
        torch.manual_seed(3)
        with drawing_for(torch.tensor([5, 2]), 7):  # rows of a batch that several processes share
            colours.append(near_field(exits))
    assert torch.equal(colours[0][[0, 0, 1]], colours[1])


def wall_colour(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """A cubic room of half side 3, its walls painted by place."""
    distance = torch.where(directions > 0, (3 - origins) / directions, (-3 - origins) / directions).amin(-1)
    places = origins + distance[:, None] * directions
    return 0.5 + 0.4 * torch.sin(1.7 * places + torch.tensor([0.0, 1.0, 2.0]))


def photographs(num_views: int, seed: int) -> tuple[Path, torch.Tensor]:
    """Paths and colours of all pixels of cameras around a glass ball in the room."""
    generator = torch.Generator().manual_seed(seed)
    back = normalize(torch.randn(num_views, 3, generator=generator), dim=-1)
    right = normalize(torch.linalg.cross(torch.randn(num_views, 3, generator=generator), back), dim=-1)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, 2 * back], -1)
    focal, centre = torch.full((num_views,), 17.5), torch.full((num_views,), 12.0)
    cameras = Cameras(pose, focal, focal, centre, centre, 24, 24, 0.5, 5.0)
    view, row, column = torch.cartesian_prod(torch.arange(num_views), torch.arange(24), torch.arange(24)).unbind(-1)
    path = Snell()(cameras.rays(view, row, column), Ball(radius=0.8))
    # The last bend, or the camera; in air from there on.
    last = torch.where(path.refracted, (path.s < path.far[:, None]).sum(1) - 1, 0)
    origins = path.positions[torch.arange(len(last)), last]
    return path, wall_colour(origins, path.exit_directions)


def trained_psnr(boundary: Boundary, rate: float, num_steps: int) -> tuple[float, float]:
    """PSNR of unseen views, of all pixels and of those behind glass."""
    path, target = photographs(20, 1)
    optimizer = torch.optim.Adam(boundary.parameters(), eps=1e-15)
    for step in range(num_steps):
        if step > 0:
            boundary.after_step(step)
        optimizer.param_groups[0]["lr"] = rate * 0.1 ** (step / num_steps)
        chosen = torch.randint(len(target), (512,))
        batch = path[chosen]
        loss = (boundary(batch.exits()) - target[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    boundary.eval()
    path, target = photographs(2, 2)
    with torch.no_grad():
        error = (boundary(path.exits()) - target).square().mean(-1)
    return tuple(float(-10 * torch.log10(e.mean())) for e in (error, error[path.refracted]))


def test_a_room_converges_where_a_sky_cannot():
    room = trained_psnr(NearField(**BOX, **SMALL), 1e-2, 120)
    sky = trained_psnr(EnvironmentMap([4, 8, 16, 32]), 2e-2, 120)
    assert min(room) > 16
    assert room[0] > sky[0] + 5
    assert room[1] > sky[1] + 3


def test_density_is_remembered_while_training(near_field):
    near_field.after_step(8)
    assert near_field.sampler.density.max() == 0
    near_field.after_step(16)
    assert near_field.sampler.density.max() > 0
    assert "sampler.density" in near_field.state_dict()  # so that a resumed run goes on with it


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"box_min": [0.0, 0, 0], "box_max": [1.0, 0, 1]}, "is no box"),
        ({"radius": 0.0}, "radius=0.0 is not allowed; take more than 0"),
        ({"num_samples": 0}, "num_samples=0"),
    ],
)
def test_impossible_options_are_refused(fields, message):
    with pytest.raises(NerfroError, match=message):
        NearField(**fields)


def test_mixed_refraction_takes_the_direction_that_it_is_given(near_field):
    path = straight_path(rays([[0.2, 0.1, 9.0]], [[0.0, 0.0, -1.0]]))
    aside = normalize(torch.tensor([[0.3, 0.0, -1.0]]), dim=-1)
    assert not torch.equal(near_field(path.exits(aside)), near_field(path.exits()))
    assert torch.equal(near_field(replace(path, exit_directions=aside).exits()), near_field(path.exits(aside)))
