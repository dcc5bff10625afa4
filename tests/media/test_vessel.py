"""Vessels: rays through walls and liquids against closed forms, openings, and refused settings."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from nerfro.geometry.mesh import load_mesh
from nerfro.media.bodies import Bodies
from nerfro.media.vessel import find_lid, make_vessel
from nerfro.viewing.surface import surface_of
from tests.closed_forms import angle, make_rays
from tests.conftest import refused
from tests.media.vessels import RADIUS, WALL, exit_directions, spherical_vessel
from tests.reference_tracer import Snell, trace_interfaces

# A glass: its height, its radii below and above, its wall.
HEIGHT, BELOW, ABOVE, THIN = 1.6, 0.4, 0.55, 0.05


def _rays_at_the_ball(count: int) -> tuple[np.ndarray, np.ndarray]:
    """From a distance of 3, to points spread through the ball."""
    random = np.random.default_rng(0)
    origins, targets = random.normal(size=(2, count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    targets *= 0.97 * RADIUS * random.random((count, 1)) ** (1 / 3) / np.linalg.norm(targets, axis=1, keepdims=True)
    directions = targets - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _errors(vessel: Bodies, wall: float, surface: float | None) -> torch.Tensor:
    """Angles to the exit directions of the formulas, degrees, of rays that leave."""
    origins, directions = _rays_at_the_ball(400)
    expected, left = exit_directions(origins, directions, wall, surface)
    assert left.mean() > 0.95
    rays = make_rays(torch.from_numpy(origins), torch.from_numpy(directions), 0.5, 9.0)
    found = Snell().trace(rays, vessel).path.exit_directions
    return angle(found.double(), torch.from_numpy(expected))[left]


@pytest.mark.parametrize("wall", [WALL, 0.008], ids=["thick", "thinner than a voxel"])
@pytest.mark.parametrize("full", [True, False], ids=["full", "half full"])
def test_rays_through_a_spherical_vessel_match_closed_forms(tmp_path: Path, wall: float, full: bool) -> None:
    # The level in the ruler's unit: this ball is 160 high.
    half_full = {"wall": 100 * wall, "foot": 100 * wall, "level": 90.0, "height": 160.0}
    vessel = spherical_vessel(tmp_path, **({"wall": wall} if full else half_full))
    errors = _errors(vessel, wall, None if full else 0.1)
    # Where the liquid meets the wall, and after several total reflections, errors multiply.
    assert errors.quantile(1 if full else 0.95) < 0.1
    assert errors.median() < (0.01 if full else 0.02)


def _glass(folder: Path, **options: object) -> Bodies:
    """A conical glass of radius 0.4 at the foot and 0.55 at the brim, from z = -0.8 to 0.8."""
    outline = [[0, -0.5 * HEIGHT], [BELOW, -0.5 * HEIGHT], [ABOVE, 0.5 * HEIGHT], [0, 0.5 * HEIGHT]]
    trimesh.creation.revolve(np.array(outline), sections=160).export(folder / "glass.ply")
    known = {"wall": THIN, "foot": 0.2, "level": 1.0, "resolution": 96, "cache": False, "box_min": [-1] * 3,
             "box_max": [1] * 3}  # fmt: skip
    return make_vessel(str(folder / "glass.ply"), **known | options)


@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
def test_inner_wall_is_an_offset_of_the_outer_wall_with_an_opening(tmp_path: Path, closed: bool) -> None:
    vessel = _glass(tmp_path, closed=closed)
    slope = np.arctan2(ABOVE - BELOW, HEIGHT)
    turn, z = (torch.from_numpy(values) for values in np.meshgrid(np.linspace(0, 6, 40), np.linspace(-0.5, 0.6, 12)))
    radius = BELOW + (z + 0.5 * HEIGHT) / HEIGHT * (ABOVE - BELOW) - THIN / np.cos(slope)
    cavity, normals = vessel.signed_distances(torch.stack([radius * turn.cos(), radius * turn.sin(), z], -1).float())
    assert cavity[..., 1].abs().max() < 2e-3
    # Of the cavity, the normal points out of it: away from the axis, and down.
    expected = torch.stack([np.cos(slope) * turn.cos(), np.cos(slope) * turn.sin(), -np.sin(slope) + 0 * turn], -1)
    assert angle(normals[..., 1, :].double().reshape(-1, 3), expected.reshape(-1, 3)).max() < 1.5
    below_the_brim = torch.tensor([[0.0, 0.1, 0.5 * HEIGHT - 0.5 * THIN]])
    assert bool(vessel.signed_distances(below_the_brim)[0][0, 1] > 0) == closed


def test_fillet_is_a_circle_tangent_to_wall_and_foot(tmp_path: Path) -> None:
    trimesh.creation.cylinder(0.5, HEIGHT, sections=256).export(tmp_path / "cylinder.ply")
    wall, foot, fillet, box = 0.05, 0.2, 0.15, {"box_min": [-1.0] * 3, "box_max": [1.0] * 3}
    vessel = make_vessel(str(tmp_path / "cylinder.ply"), wall, foot, resolution=96, cache=False, fillet=fillet, **box)
    turn, bend = (torch.from_numpy(x) for x in np.meshgrid(np.linspace(0, 6, 20), np.linspace(0.1, 1.5, 15)))
    radius, z = 0.5 - wall - fillet * (1 - bend.cos()), -0.5 * HEIGHT + foot + fillet * (1 - bend.sin())
    cavity, normals = vessel.signed_distances(torch.stack([radius * turn.cos(), radius * turn.sin(), z], -1).float())
    assert cavity[..., 1].abs().max() < 2e-3
    expected = torch.stack([bend.cos() * turn.cos(), bend.cos() * turn.sin(), -bend.sin()], -1)
    assert angle(normals[..., 1, :].double().reshape(-1, 3), expected.reshape(-1, 3)).max() < 1.5


def test_light_enters_an_opening_freely_and_meets_water_glass_and_air(tmp_path: Path) -> None:
    d = torch.nn.functional.normalize(torch.tensor([[0.06, 0.02, -1.0]], dtype=torch.float64), dim=-1)
    trace = Snell().trace(make_rays(-2.5 * d, d, 0.5, 9.0), _glass(tmp_path))
    assert trace.num_events.item() == 3
    assert trace.path.record.body[0, :4].tolist() == [0, 3, 1, 0]
    # Level, foot and bottom are parallel planes.
    assert angle(trace.path.exit_directions, d).item() < 0.02
    torch.testing.assert_close(
        trace.path.positions[0, 1:4, 2], torch.tensor([0.2, -0.6, -0.8]).double(), atol=2e-3, rtol=0
    )


@pytest.mark.slow
def test_slanted_rays_enter_an_opening_as_in_the_reference_implementation(tmp_path: Path) -> None:
    glass = _glass(tmp_path)
    random = np.random.default_rng(0)
    angles, radius = random.uniform(0, 2 * np.pi, 2000), 0.9 * ABOVE * np.sqrt(random.random(2000))
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(2000, 0.5 * HEIGHT)], -1)
    slope = random.uniform(0.5, 1.5, 2000)
    directions = np.stack([slope, 0 * slope, -np.ones(2000)], -1) / np.hypot(slope, 1)[:, None]
    rays = make_rays(torch.from_numpy(places - 2 * directions), torch.from_numpy(directions), 0.0, 9.0)
    found, expected = Snell().trace(rays, glass).path, trace_interfaces(rays, glass, 16).path
    assert (angle(found.exit_directions, expected.exit_directions) > 1).float().mean() < 1e-3


def test_paths_through_a_glass_have_gradients_by_its_indices(tmp_path: Path) -> None:
    vessel = _glass(tmp_path)
    random = torch.Generator().manual_seed(0)
    targets = 0.3 * (2 * torch.rand(80, 3, generator=random, dtype=torch.float64) - 1)
    origins = torch.nn.functional.normalize(torch.randn(80, 3, generator=random, dtype=torch.float64), dim=-1) * 2.5
    rays = make_rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1), 0.5, 9.0)
    sampler, step = Snell(max_events=6), 1e-4
    iors = vessel.iors.clone().requires_grad_()
    learning = vessel.with_indices(iors)
    path = sampler(rays, learning)
    weights = torch.randn(80, 3, generator=random, dtype=torch.float64) * sampler.steady(path, learning)[:, None]
    (found,) = torch.autograd.grad((sampler.replay(path, rays, learning).exit_directions * weights).sum(-1).sum(), iors)
    for body in (0, 2):
        change = step * torch.nn.functional.one_hot(torch.tensor(body), 3)
        low, high = (sampler(rays, vessel.with_indices(vessel.iors + sign * change)) for sign in (-1, 1))
        same = (low.record.body.shape == path.record.body.shape == high.record.body.shape) and bool(
            (low.record.body == path.record.body).all() and (high.record.body == path.record.body).all()
        )
        assert same
        expected = ((high.exit_directions - low.exit_directions) * weights).sum() / (2 * step)
        assert found[body].item() == pytest.approx(expected.item(), rel=0.02)


@pytest.mark.slow
def test_cavity_and_liquid_surfaces_have_their_volumes(tmp_path: Path) -> None:
    vessel = spherical_vessel(tmp_path, level=0.9)
    inner, top = RADIUS - WALL, 0.1
    below = np.pi * (2 / 3 * inner**3 + inner**2 * top - top**3 / 3)  # of a ball, under a plane
    cavity, liquid = (trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in surface_of(vessel, False)[1:])
    assert abs(cavity.volume) == pytest.approx(4 / 3 * np.pi * inner**3, rel=0.01)
    assert abs(liquid.volume) == pytest.approx(below, rel=0.01)
    assert liquid.bounds[1, 2] == pytest.approx(top, abs=0.01)


def test_lid_consists_of_upward_faces_around_the_highest_point(tmp_path: Path) -> None:
    _glass(tmp_path, resolution=40)
    mesh = load_mesh(tmp_path / "glass.ply")
    lid = mesh.triangles[find_lid(mesh, np.array([0.0, 0.0, 1.0]))]
    assert np.linalg.norm(np.cross(lid[:, 1] - lid[:, 0], lid[:, 2] - lid[:, 0]), axis=1).sum() / 2 == pytest.approx(
        np.pi * ABOVE**2, rel=0.01
    )
    assert np.allclose(lid[..., 2], 0.5 * HEIGHT)
    bottom = mesh.triangles[find_lid(mesh, np.array([0.0, 0.0, -1.0]))]
    assert np.allclose(bottom[..., 2], -0.5 * HEIGHT)


def test_tint_and_dispersion_are_those_of_wall_and_liquid(tmp_path: Path) -> None:
    materials = {
        "glass": {"ior": 1.5, "absorption": [1, 2, 3], "abbe": 60},
        "liquid": {"ior": 1.333, "absorption": [4, 5, 6], "abbe": 55},
    }
    vessel = spherical_vessel(tmp_path, level=0.9, resolution=40, **materials)
    assert vessel.absorption.tolist() == [[1, 2, 3], [0, 0, 0], [4, 5, 6]]
    assert vessel.at_wavelength(486.13).iors[1] == 1
    dyed = vessel.with_indices(torch.ones(3))
    rays = make_rays([[0.1, 0.0, 3.0]], [[0, 0.0, -1]], 0.5, 9.0)
    for trace in (Snell().trace(rays, dyed), trace_interfaces(rays, dyed, 16)):
        # The wall, clear air, the liquid, the wall again, and the air outside.
        assert trace.path.record.body[0, :6].tolist() == [0, 1, 0, 3, 1, 0]
        assert not trace.num_events.any()
    learning = spherical_vessel(tmp_path, level=0.9, resolution=40, learn_absorption=True)
    assert (learning.absorption[1] == 0).all()
    assert (learning.absorption[[0, 2]] > 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wall": 0.9, "foot": 0.1}, "leave no cavity: no point of the body is deeper than"),
        ({"level": 1.7}, r"medium\.foot=0\.1 and medium\.level=1\.7 is not allowed: heights .* is 1\.6 high"),
        ({"foot": 20.0, "height": 16.0}, "the vessel is 16 high"),
        ({"up": [0.0, 0.0, 0.0]}, "is no direction; give three numbers"),
        ({"glass": {"ior": 1.5, "mesh": "glass.ply"}}, "describe materials; remove"),
    ],
)
def test_impossible_vessels_are_refused_in_one_line(tmp_path: Path, options: dict[str, object], message: str) -> None:
    refused(message, spherical_vessel, tmp_path, 2, resolution=40, **options)


def test_grown_vessel_keeps_its_wall_thickness(tmp_path: Path) -> None:
    vessel = spherical_vessel(tmp_path, wall=WALL)
    larger = vessel.grown(torch.full_like(vessel.grids[0].distances, 0.02))
    torch.testing.assert_close(larger.grids[0].distances, vessel.grids[0].distances - 0.02)
    # Where the wall and not the foot bounds the cavity, before and after.
    by_wall = (vessel.grids[1].distances == vessel.grids[1].side + WALL) & (
        larger.grids[1].distances == larger.grids[1].side + WALL
    )
    assert by_wall.float().mean() > 0.5
    torch.testing.assert_close(larger.grids[1].distances[by_wall], vessel.grids[1].distances[by_wall] - 0.02)
