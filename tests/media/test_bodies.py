"""Bodies: distances, shells, nesting, overlaps, grids made of meshes, settings by name, and the materials."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path as RayPath
from nerfro.core.types import Rays
from nerfro.media.base import Medium, Vacuum
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import BodySettings, expanded, make_bodies
from nerfro.media.distance_grid import SURFACE_BLOCK
from nerfro.media.material import MATERIALS
from nerfro.paper.eikonal import Eikonal
from tests.closed_forms import Ball, Luneburg, RoundedBox, Slab, angle, ball_exits, grid_points, make_rays, sampled
from tests.conftest import refused
from tests.reference_tracer import Snell, trace_interfaces

CENTRES = ((-10.0, 0.0, 0.0), (10.0, 0.0, 0.0))  # of balls of radius 1


def _ball(folder: Path, centre: tuple[float, ...], subdivisions: int = 4) -> str:
    shape = trimesh.creation.icosphere(subdivisions, 1.0)
    shape.apply_translation(centre)
    file = folder / f"ball{'_'.join(map(str, centre))}.ply"
    shape.export(file)
    return str(file)


def _medium(resolution: int = 48, **bodies: dict[str, Any]) -> Bodies:
    return make_bodies(bodies=bodies, resolution=resolution, cache=False)


def _rays_at(centre: tuple[float, ...], num: int = 300) -> Rays:
    """Rays along -z through a ball."""
    generator = torch.Generator().manual_seed(0)
    height, turn = 0.9 * torch.rand(num, generator=generator).sqrt(), 2 * math.pi * torch.rand(num, generator=generator)
    origins = torch.stack([height * turn.cos(), height * turn.sin(), torch.full((num,), 3.0)], -1)
    return make_rays(origins + torch.tensor(centre), [[0.0, 0.0, -1.0]] * num, 0.5, 8.0)


@pytest.mark.parametrize("tracer", ["kernel", "reference", "triangles", "eikonal"])
def test_two_balls_far_apart_are_as_exact_as_each_alone(tracer: str, tmp_path: Path) -> None:
    files = [_ball(tmp_path, centre) for centre in CENTRES]
    both = _medium(a={"mesh": files[0], "ior": 1.5}, b={"mesh": files[1], "ior": 1.33})

    def exits(rays: Rays, medium: Bodies) -> Tensor:
        if tracer == "reference":
            return trace_interfaces(rays, medium, 16).path.exit_directions
        sampler = {"kernel": Snell(), "triangles": Snell("mesh"), "eikonal": Eikonal()}[tracer]
        return sampler(rays, medium).exit_directions

    for file, centre, ior in zip(files, CENTRES, (1.5, 1.33), strict=True):
        rays, alone = _rays_at(centre), make_bodies(file, ior, resolution=48, cache=False)
        expected = ball_exits(rays, 1.0, ior, centre)
        errors = [angle(exits(rays, medium), expected) for medium in (both, alone)]
        assert errors[0].median() < (0.1 if tracer == "eikonal" else 0.03)
        torch.testing.assert_close(*errors, atol=1e-4 if tracer == "eikonal" else 1e-9, rtol=1e-3)


@pytest.mark.parametrize("gap", [0.0, 1e-5, -1e-5])
@pytest.mark.parametrize("upper_first", [True, False])
def test_light_passes_from_one_touching_body_to_the_other(gap: float, upper_first: bool, tmp_path: Path) -> None:
    """It would be totally reflected at a layer of air, however thin."""
    for name, z in (("upper", 0.6 + gap), ("lower", -0.6)):
        shape = trimesh.creation.box((2.0, 2.0, 1.2), trimesh.transformations.translation_matrix([0, 0, z]))
        shape.export(tmp_path / f"{name}.ply")
    settings = {"upper": {"ior": 1.5}, "lower": {"ior": 1.4}}
    names = ["upper", "lower"] if upper_first else ["lower", "upper"]
    medium = _medium(**{name: {"mesh": str(tmp_path / f"{name}.ply"), **settings[name]} for name in names})
    direction = torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64)
    rays = make_rays(torch.tensor([[-1.0, 0.1, 0.6]]) - 2 * direction, direction, 0.5, 9.0)
    along_x = math.sqrt(1.5**2 - 0.8**2)
    expected = torch.tensor([along_x, 0.0, -math.sqrt(1.4**2 - along_x**2)], dtype=torch.float64) / 1.4
    numbers = [1 + names.index("upper"), 1 + names.index("lower")]
    for path in (Snell()(rays, medium), Snell("mesh")(rays, medium), trace_interfaces(rays, medium, 16).path):
        assert path.record.body[0, :3].tolist() == [0, *numbers]
        assert angle(path.directions[0, 2], expected) < 0.01


@pytest.mark.parametrize("interface", ["sdf", "mesh"])
def test_gap_is_air_from_both_sides_if_the_smaller_body_resolves_it(
    interface: Literal["sdf", "mesh"], tmp_path: Path
) -> None:
    """Light can be followed backwards, although the searches for the two surfaces have steps of different lengths."""
    gap = 4e-4  # between the steps, 2e-4 and 1e-3
    for name, side, z in (("small", 0.5, 0.25 + gap), ("large", 4.0, -2.0)):
        shape = trimesh.creation.box([side] * 3, trimesh.transformations.translation_matrix([0, 0, z]))
        shape.export(tmp_path / f"{name}.ply")
    medium = _medium(**{name: {"mesh": str(tmp_path / f"{name}.ply"), "ior": 1.5} for name in ("small", "large")})
    directions = torch.tensor([[0.1, 0.0, -0.99499], [-0.1, 0.0, 0.99499]])
    origins = torch.tensor([[-0.1, 0.0, 1.0], [0.5, 0.0, -5.0]])
    path = Snell(interface)(make_rays(origins, directions, 0.0, 9.0), medium)
    assert path.record.body[:, :6].tolist() == [[0, 1, 0, 2, 0, 0], [0, 2, 0, 1, 0, 0]]


@pytest.mark.parametrize(
    ("order", "priorities", "owner"),
    [("ab", (0, 0), "b"), ("ba", (0, 0), "a"), ("ab", (1, 0), "a"), ("ba", (0, 1), "b"), ("ba", (-1, 0), "b")],
)
def test_priority_or_order_decides_where_bodies_overlap(
    order: str, priorities: tuple[int, int], owner: str, tmp_path: Path
) -> None:
    centres = {"a": (0.0, 0.0, 0.5), "b": (0.0, 0.0, -0.5)}
    settings = {
        name: {"mesh": _ball(tmp_path, centre), "ior": ior, "priority": priority}
        for (name, centre), ior, priority in zip(centres.items(), (1.5, 1.3), priorities, strict=True)
    }
    medium = _medium(**{name: settings[name] for name in order})
    rays = make_rays([[0.0, 0.0, 3.0]], [[0.0, 0.0, -1.0]], 0.5, 8.0)
    # On the axis light does not turn; the overlap reaches from z = 0.5 to -0.5.
    background = 0.5 if owner == "b" else -0.5
    for path in (Snell()(rays, medium), trace_interfaces(rays, medium, 16).path):
        assert [medium.names[body - 1] for body in path.record.body[0, 1:3]] == ["a", "b"]
        torch.testing.assert_close(
            path.positions[0, 1:4, 2], torch.tensor([1.5, background, -1.5]).double(), atol=2e-3, rtol=0
        )
    n, _ = medium(torch.tensor([[0.0, 0.0, 0.0]]))
    assert float(n) == pytest.approx(settings[owner]["ior"], abs=1e-6)


@pytest.mark.slow
def test_index_and_absorption_of_two_bodies_are_learned_together(tmp_path: Path) -> None:
    files = [_ball(tmp_path, centre) for centre in CENTRES]
    medium = _medium(
        resolution=32,
        glass={"mesh": files[0], "ior": 1.45, "learn": ["ior"]},
        tinted={"mesh": files[1], "ior": 1.33, "absorption": [0.2, 0.2, 0.2], "learn": ["absorption"]},
    )
    ior, absorption = "bodies.glass.material.ior", "bodies.tinted.material.absorption"
    parameters = medium.parameters_by_name()
    assert list(parameters) == [ior, absorption]
    clear, tinted = (_rays_at(centre, 100) for centre in CENTRES)
    expected = ball_exits(clear, 1.0, 1.5, CENTRES[0])
    sigma = torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64)
    groups = [{"params": [parameters[name]], "lr": rate} for name, rate in ((ior, 0.02), (absorption, 0.1))]
    sampler, optimizer = Snell(), torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.96)

    def refined(rays: Rays) -> RayPath:
        return medium.with_absorption(sampler.replay(sampler(rays, medium), rays, medium))

    for _ in range(120):
        path = refined(tinted)
        chords = (path.s[:, 2] - path.s[:, 1]).detach()[:, None]
        seen = path.whole_transmittance()
        loss = (seen - torch.exp(-sigma * chords)).square().mean()
        loss = loss + (refined(clear).exit_directions - expected).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    learned = medium.measurements()
    assert learned[ior] == pytest.approx(1.5, abs=2e-3)
    colours = [learned[f"{absorption}.{colour}"] for colour in ("red", "green", "blue")]
    assert colours == pytest.approx(sigma.tolist(), abs=5e-3)


def test_empty_list_of_learned_quantities_keeps_a_body_constant(tmp_path: Path) -> None:
    files = [_ball(tmp_path, centre) for centre in CENTRES]
    bodies = {"glass": {"mesh": files[0], "ior": 1.45}, "water": {"mesh": files[1], "ior": 1.33, "learn": []}}
    medium = make_bodies(bodies=bodies, learn_ior=True, resolution=16, cache=False)
    assert list(medium.parameters_by_name()) == ["bodies.glass.material.ior"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ior": 1.5, "index": 1}, r"bodies\.glass\.index is not a setting"),
        ({}, "needs one of ior and material"),
        ({"material": "watr"}, "'watr' is not a material; .*water"),
        ({"material": "water", "abbe": 50}, "contradicts its material"),
        ({"ior": -1}, r"bodies\.glass\.ior=-1 is not allowed"),
        ({"ior": 1.5, "absorption": [0.1, 0.2]}, "give red, green and blue, or one"),
        ({"ior": 1.5, "learn": ["colour"]}, "choose ior and absorption"),
        ({"ior": 1, "learn": ["ior"]}, "has no gradient; start from another value"),
        ({"ior": 1.5, "mesh": None}, r"bodies\.glass needs a mesh"),
        ({"ior": 1.5, "mesh": "missing.ply"}, "missing.ply"),
        (
            {"ior": 1.5, "mesh": None, "surface": {"name": "ball", "radus": 1}},
            r"bodies\.glass\.surface\.radus is not a setting; did you mean radius\?",
        ),
        (1.5, r"bodies\.glass=1.5 is not a set of settings"),
    ],
)
def test_wrong_bodies_are_refused_by_name(settings: Any, message: str, tmp_path: Path) -> None:
    if isinstance(settings, dict):
        settings = {"mesh": _ball(tmp_path, (0.0, 0.0, 0.0), 2), **settings}
    refused(message, _medium, 16, glass=settings)


def test_mesh_and_index_are_short_for_one_body(tmp_path: Path) -> None:
    mesh = _ball(tmp_path, (0.0, 0.0, 0.0), 2)
    assert expanded({"mesh": mesh, "ior": 1.4}) == {"object": BodySettings(mesh=mesh, ior=1.4)}
    assert expanded({"mesh": mesh, "bodies": {"object": {"ior": 1.4}}}) == expanded({"mesh": mesh, "ior": 1.4})
    refused("needs mesh", make_bodies)


# Index of the d line and Abbe number, as data sheets and handbooks print them.
PUBLISHED = {
    "water": (1.3334, 55.8), "soda_lime": (1.523, 64.0), "borosilicate": (1.4714, 65.7), "n_bk7": (1.5168, 64.17),
    "acrylic": (1.4906, 53.2), "polycarbonate": (1.5848, 27.9), "sapphire": (1.7682, 72.2), "diamond": (2.4175, 55.3),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_materials_have_their_published_index_and_abbe_number(name: str, tmp_path: Path) -> None:
    ior, abbe = PUBLISHED[name]
    assert MATERIALS[name].ior == pytest.approx(ior, abs=4e-4)
    assert MATERIALS[name].abbe == pytest.approx(abbe, rel=6e-3)
    medium = _medium(16, body={"mesh": _ball(tmp_path, (0.0, 0.0, 0.0), 2), "material": name})
    for wavelength in Snell().wavelengths:
        at = medium.at_wavelength(wavelength).iors
        assert at.tolist() == pytest.approx([MATERIALS[name].index(wavelength / 1000)], abs=1e-12)


BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


def _nested_balls(size: int = 48) -> Bodies:
    radius = grid_points(1.5, size).norm(dim=-1)
    return sampled(torch.stack([radius - 0.9, radius - 0.5]), BOX, [1.5, 1.33], 0.1)


def _half_full_ball() -> Bodies:
    """Bodies that are where all before them are: a wall of glass, air in it, water in its lower half."""
    balls = _nested_balls()
    outer, inner = (grid.distances for grid in balls.grids)
    distances = [outer, inner, torch.linspace(-1.5, 1.5, len(outer)).expand(outer.shape)]
    medium = sampled(distances, BOX, [1.5, 1.0, 1.33], 0.1)
    medium.nested = True
    return medium


MEDIA = [
    Vacuum(),
    Luneburg(),
    Ball(shell=0.3),
    RoundedBox(shell=0.05, edge_radius=0.3),
    Slab(shell=0.1),
    _nested_balls(),
    _half_full_ball(),
]


@pytest.mark.parametrize("medium", MEDIA, ids=lambda medium: type(medium).__name__)
def test_gradient_is_the_derivative_of_the_index(medium: Medium) -> None:
    medium = medium.double()
    low, high = 0.97 * medium.box
    positions = low + (high - low) * torch.rand(300, 3, dtype=torch.float64)
    # Central differences are of no use across a kink.
    smooth = (medium(positions * (1 + 1e-3))[1] != 0).any(-1) == (medium(positions * (1 - 1e-3))[1] != 0).any(-1)
    positions = positions[smooth].requires_grad_()
    n, gradient = medium(positions)
    if n.requires_grad:
        (automatic,) = torch.autograd.grad(n.sum(), positions)
        torch.testing.assert_close(gradient, automatic, rtol=1e-4, atol=1e-4)
    else:
        assert (gradient == 0).all()


def test_last_body_decides_the_index() -> None:
    medium = _nested_balls()
    n, gradient = medium(torch.tensor([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 1.2, 0.0], [0.5, 0.0, 0.0]]))
    torch.testing.assert_close(n, torch.tensor([1.33, 1.5, 1.0, 1.415]), atol=2e-3, rtol=0)
    assert (gradient[:3] == 0).all()
    # From liquid into glass the index rises outwards.
    assert gradient[3, 0] > 0.5


def test_nested_body_lies_within_the_bodies_before_it() -> None:
    medium = _half_full_ball()
    places = torch.tensor([[0.0, 0.0, -0.3], [0.0, 0.0, 0.3], [0.7, 0.0, -0.2], [0.7, 0.0, 0.0], [1.2, 0.0, -0.5]])
    n, gradient = medium(places)
    torch.testing.assert_close(n, torch.tensor([1.33, 1.0, 1.5, 1.5, 1.0]), atol=2e-3, rtol=0)
    assert (gradient == 0).all()
    assert medium.deciding_body(medium.signed_distances(places)[0] < 0).tolist() == [3, 0, 1, 1, 0]


@pytest.mark.parametrize("make", [_nested_balls, _half_full_ball])
def test_clearance_reaches_no_shell(make: Callable[[], Bodies]) -> None:
    medium = make()
    positions = torch.rand(500, 3) * 2.8 - 1.4
    clearance = medium.clearance(positions)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    _, gradient = medium(positions + 0.99 * clearance[:, None] * directions)
    assert (gradient[clearance > 0.01] == 0).all()


def test_coarse_clearance_is_a_lower_bound() -> None:
    grid = _nested_balls(43).grids[0]
    block = 4 * 3 / 42
    positions = torch.rand(2000, 3) * 3 - 1.5
    coarse = grid.coarse_clearance()[((positions + 1.5) / block).long().unbind(-1)]
    exact = (positions.norm(dim=-1) - 0.9).abs()
    assert (coarse <= exact + 1e-6).all()
    # Short by the diagonals of a block and a cell, at most.
    assert (coarse >= exact - 3**0.5 * (block + 3 / 42) - 1e-6).all()


def test_coarse_slopes_bound_all_derivatives() -> None:
    medium = _nested_balls(43)
    block = SURFACE_BLOCK * 3 / 42
    positions = torch.rand(20000, 3, dtype=torch.float64) * 3 - 1.5
    x, y, z = ((positions + 1.5) / block).long().unbind(-1)
    bounds = torch.stack([grid.coarse_slopes().double()[x, y, z] for grid in medium.grids], 1)
    gradients = medium.signed_distances(positions)[1]
    assert (bounds[..., 0] <= gradients + 1e-5).all()
    assert (gradients <= bounds[..., 1] + 1e-5).all()
    # Where the outer ball is nearly flat they are narrow.
    bounded = bounds[:, 0].isfinite().all(-1).all(-1) & ((positions.norm(dim=-1) - 0.9).abs() < 0.05)
    assert bounded.sum() > 500
    assert (bounds[bounded, 0, :, 1] - bounds[bounded, 0, :, 0]).median() < 0.9


def test_empty_blocks_contain_no_surface() -> None:
    medium = _nested_balls(43)
    block = SURFACE_BLOCK * 3 / 42
    empty = medium.grids[0].empty_blocks()
    positions = torch.rand(20000, 3, dtype=torch.float64) * 3 - 1.5
    places = ((positions + 1.5) / block).long().clamp(max=len(empty) - 1)
    signs = medium.grids[0](positions)[0] < 0
    side = empty[places.unbind(-1)].long()
    reach = side.abs()
    assert torch.equal(side[reach > 0] < 0, signs[reach > 0])
    # As far as the blocks around are empty, the body is on the same side of a place as of that block's middle.
    moved = (places + (torch.rand(20000, 3) * 2 - 1) * (reach[:, None] - 1) + torch.rand(20000, 3)) * block - 1.5
    moved = moved.round(decimals=6).clamp(-1.5, 1.5)
    rows = (reach > 0) & (((moved + 1.5) / block - (places + 0.5)).abs().amax(-1) < reach - 0.5)
    assert rows.sum() > 10000
    assert torch.equal(signs[rows], medium.grids[0](moved[rows])[0] < 0)
    # Blocks are empty but for those around the surface, and some at the border.
    near = (positions.norm(dim=-1) - 0.9).abs()
    assert (reach[near < 0.01] == 0).all()
    assert (reach[(near > 3**0.5 * (block + 2 * 3 / 42)) & (positions.abs().amax(-1) < 1.2)] > 0).all()


def test_bad_solids_are_named(tmp_path: Path) -> None:
    trimesh.creation.icosphere(2, 0.8).export(tmp_path / "ball.ply")
    mesh = str(tmp_path / "ball.ply")
    refused(r"box_min=.*box_max=", make_bodies, mesh, box_min=[-1.5] * 3, box_max=[0.7] * 3, resolution=16, cache=False)
    with pytest.raises(NerfroError, match=r"medium\.box_min and medium\.box_max belong together"):
        make_bodies(mesh, box_max=[1.5] * 3, resolution=16, cache=False)


@pytest.mark.parametrize("sides", [(2.0, 2.0, 2.0), (3.0, 1.0, 0.6)])
@pytest.mark.parametrize("resolution", [12, 33])
def test_default_box_encloses_the_object_tightly(sides: tuple[float, ...], resolution: int, tmp_path: Path) -> None:
    trimesh.creation.box(sides, trimesh.transformations.translation_matrix([5, -7, 9])).export(tmp_path / "box.ply")
    medium = make_bodies(str(tmp_path / "box.ply"), resolution=resolution, cache=False)
    spacing = (medium.box[1] - medium.box[0]) / (resolution - 1)
    assert spacing.max() < 2.01 * spacing.min()
    air = torch.stack([medium.content_box[0] - medium.box[0], medium.box[1] - medium.content_box[1]])
    assert (air > (2 if resolution == 12 else 3.9) * spacing).all()
    assert air.min() < 4.1 * spacing.max()
