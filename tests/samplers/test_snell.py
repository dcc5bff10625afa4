"""Snell paths against closed-form optics, independent tracers, and the plain reference of the compiled kernel."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from benchmarks.rounded_cube import trace_rounded_cube
from nerfro.core.errors import NerfroError
from nerfro.core.types import Rays
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell_law import refract
from tests.closed_forms import (
    Ball,
    Luneburg,
    RoundedBox,
    Slab,
    angle,
    ball_exits,
    beam,
    grid_points,
    make_rays,
    random_rays,
    sampled,
)
from tests.conftest import refused
from tests.reference_tracer import Snell, trace_interfaces

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


def _rays(origins: list | Tensor, directions: list | Tensor, near: float = 0.5, far: float = 9.0) -> Rays:
    return make_rays(origins, directions, near, far)


def _grid(values: Tensor, iors: list[float]) -> Bodies:
    return sampled(values, BOX, iors, 0.02)


def _mesh_medium(shape: trimesh.Trimesh, folder: FilePath, ior: float = 1.5, resolution: int = 48) -> Bodies:
    shape.export(folder / "shape.ply")
    return make_bodies(str(folder / "shape.ply"), ior, resolution=resolution, cache=False)


# --- the law ---


def test_refraction_keeps_n_times_sine_and_the_plane_of_incidence() -> None:
    d = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    normal = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    n1, n2 = torch.rand(50, dtype=torch.float64) + 1, torch.rand(50, dtype=torch.float64) + 1
    t, reflected = refract(d, normal, n1, n2)
    sine = torch.linalg.cross(d, normal)
    critical = n1 * sine.norm(dim=-1) > n2
    assert (reflected == critical).all()
    assert reflected.any()
    expected = torch.where(reflected, 1.0, n1 / n2)[:, None] * sine
    torch.testing.assert_close(torch.linalg.cross(t, normal), expected)
    forward = (d * normal).sum(-1) * (t * normal).sum(-1) > 0
    assert (forward == ~reflected).all()


# --- shapes in closed form ---


def test_ball_deviates_by_twice_the_difference_of_its_angles() -> None:
    heights = torch.linspace(-0.99, 0.99, 101, dtype=torch.float64) * 0.8
    trace = Snell().trace(beam(heights), Ball(0.8, 1.5).double())
    assert angle(trace.path.exit_directions, ball_exits(beam(heights), 0.8, 1.5)).max() < 1e-7
    assert (trace.num_events == 2).all()
    assert trace.path.s.shape[1] == 4
    # The chord inside is 2 R cos t.
    chord = trace.path.s[:, 2] - trace.path.s[:, 1]
    torch.testing.assert_close(chord, 1.6 * (1 - (heights / 1.2) ** 2).sqrt())


@pytest.mark.parametrize("bounces", [1, 2, 5])
def test_each_total_reflection_within_a_ball_turns_by_pi_less_twice_its_angle(bounces: int) -> None:
    # From inside, at an angle t to the surface beyond the critical one: every bounce turns by pi - 2 t.
    t = math.radians(50)
    start = 0.8 * math.sin(t)
    trace = Snell(max_events=bounces).trace(_rays([[0, start, 0]], [[1, 0, 0]], 0, 30), Ball(0.8, 1.5).double())
    assert trace.num_events[0] == bounces
    turn = bounces * (math.pi - 2 * t)
    expected = torch.tensor([[math.cos(turn), -math.sin(turn), 0]], dtype=torch.float64)
    assert angle(trace.path.exit_directions, expected).max() < 1e-7
    chords = trace.path.s[0, 2 : bounces + 1] - trace.path.s[0, 1:bounces]
    torch.testing.assert_close(chords, torch.full_like(chords, 1.6 * math.cos(t)))


def test_slab_shifts_rays_and_keeps_their_direction() -> None:
    angles = torch.linspace(0, 85, 18, dtype=torch.float64).deg2rad()
    directions = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    path = Snell()(_rays(-5 * directions, directions, 0, 12), Slab(0.5, 1.5).double())
    torch.testing.assert_close(path.exit_directions, directions)
    shift = 0.5 * angles.sin() * (1 - angles.cos() / (1.5**2 - angles.sin() ** 2).sqrt())
    moved = torch.linalg.cross(path.end_positions, directions).norm(dim=-1)
    torch.testing.assert_close(moved, shift, atol=1e-9, rtol=0)


def test_rounded_cube_matches_tracing_of_its_pieces() -> None:
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = generator.uniform(-0.6, 0.6, (400, 3)) - 3 * directions
    exact = [trace_rounded_cube(x, d, 0.75, 0.08, 1.52) for x, d in zip(origins, directions, strict=True)]
    trace = Snell().trace(_rays(origins, directions), RoundedBox().double())
    bounces = torch.tensor([count for _, count in exact])
    chosen = (bounces >= 0) & (bounces <= 3)
    assert (bounces[chosen] > 0).sum() > 30
    # A ray within rounding of an edge of the pieces may go another way.
    agree = trace.num_events[chosen] == bounces[chosen] + 2
    assert agree.float().mean() > 0.98
    error = angle(trace.path.exit_directions, torch.tensor(np.stack([e for e, _ in exact])))[chosen]
    assert error.median() < 1e-6
    assert error.quantile(0.95) < 1e-4


def _prism(apex: float, height: float) -> trimesh.Trimesh:
    """A prism along z whose apex points up y."""
    half = height * math.tan(apex / 2)
    corners = [(x, y, z) for z in (-0.8, 0.8) for x, y in ((-half, -height / 2), (half, -height / 2), (0, height / 2))]
    return trimesh.convex.convex_hull(np.array(corners))


def test_minimum_deviation_of_a_prism_matches_its_index(tmp_path: FilePath) -> None:
    apex, n = math.radians(50), 1.5
    medium = _mesh_medium(_prism(apex, 0.9), tmp_path, n)
    least = 2 * math.asin(n * math.sin(apex / 2)) - apex
    angles = 0.5 * (apex + least) + np.radians([-1.0, 0.0, 1.0])
    directions = np.stack([np.cos(angles - apex / 2), np.sin(angles - apex / 2), 0 * angles], -1)
    target = np.array([-0.225 * math.tan(apex / 2) * 2, 0.0, 0.1])
    path = Snell("mesh")(_rays(target - 2 * directions, directions), medium)
    before, middle, after = torch.deg2rad(angle(path.exit_directions, torch.tensor(directions))).tolist()
    # Fraunhofer: n = sin((A + Dmin) / 2) / sin(A / 2).
    assert math.sin(0.5 * (apex + middle)) / math.sin(apex / 2) == pytest.approx(n, abs=1e-7)
    assert before > middle < after
    # Steeper than this the ray meets the second face beyond the critical angle and does not leave through it.
    limit = math.asin(n * math.sin(apex - math.asin(1 / n)))
    for offset, leaves in ((0.01, True), (-0.01, False)):
        tilt = limit + offset - apex / 2
        direction = np.array([[math.cos(tilt), math.sin(tilt), 0.0]])
        trace = Snell("mesh").trace(_rays(target - 2 * direction, direction), medium)
        assert (int(trace.num_events[0]) == 2) == leaves


# --- meshes and grids ---


def _nested_exit(
    heights: Tensor, outer: float, n: float, inner: float, inner_ior: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Exit directions of the beam behind a ball in a ball, and which rays meet the inner ball or are reflected at it.

    n r sin(phi) = b everywhere.
    """
    deviation = 2 * (torch.asin(heights / outer) - torch.asin(heights / (n * outer)))
    meets = heights < n * inner
    reflected = meets & (heights > inner_ior * inner)
    i = torch.asin((heights / (n * inner)).clamp(max=1))
    t = torch.asin((heights / (inner_ior * inner)).clamp(max=1))
    bent = torch.where(reflected, 2 * i - math.pi, 2 * (i - t))
    deviation = deviation + torch.where(meets, bent, 0.0)
    return torch.stack([deviation.cos(), -deviation.sin(), 0 * heights], -1), meets, reflected


@pytest.mark.parametrize("inner_ior", [1.0, 1.33, 1.8])
def test_ball_in_a_ball_deviates_as_its_conserved_moment(inner_ior: float) -> None:
    outer, inner, n = 1.2, 0.6, 1.5
    heights = torch.linspace(0.02, 1.1, 60, dtype=torch.float64)
    radius = grid_points(1.5, 96).norm(dim=-1)
    trace = Snell().trace(beam(heights), _grid(torch.stack([radius - outer, radius - inner]), [n, inner_ior]))
    exact, meets, reflected = _nested_exit(heights, outer, n, inner, inner_ior)
    error = angle(trace.path.exit_directions, exact)
    events = torch.where(meets, torch.where(reflected, 3, 4), 2)
    # Just at grazing the grid decides otherwise than the ball.
    clear = ((heights - n * inner).abs() > 0.02) & ((heights - inner_ior * inner).abs() > 0.02)
    assert (trace.num_events == events)[clear].all()
    assert error[clear].max() < 0.3
    assert error[clear].median() < 0.02
    if inner_ior == 1.0:
        assert reflected.any()


def test_paths_through_a_cavity_do_not_depend_on_the_winding_of_triangles(tmp_path: FilePath) -> None:
    heights = torch.linspace(0.02, 0.6, 30, dtype=torch.float64)
    shape = trimesh.util.concatenate([trimesh.creation.icosphere(4, radius) for radius in (0.9, 0.45)])
    exact, *_ = _nested_exit(heights, 0.9, 1.5, 0.45, 1.0)
    reversed_ = np.random.default_rng(0).random(len(shape.faces)) < 0.5
    shape = trimesh.Trimesh(shape.vertices, np.where(reversed_[:, None], shape.faces[:, ::-1], shape.faces))
    path = Snell()(beam(heights), _mesh_medium(shape, tmp_path, resolution=96))
    assert angle(path.exit_directions, exact)[(heights - 0.45).abs() > 0.02].median() < 0.03


def test_water_that_exactly_fills_its_glass_matches_closed_form(tmp_path: FilePath) -> None:
    heights = torch.linspace(0.02, 0.8, 40, dtype=torch.float64)
    water = trimesh.creation.icosphere(4, 0.7)
    trimesh.util.concatenate([trimesh.creation.icosphere(4, 0.9), water]).export(tmp_path / "glass.ply")
    water.export(tmp_path / "water.ply")
    glass, inner = str(tmp_path / "glass.ply"), str(tmp_path / "water.ply")
    bodies = {"glass": {"mesh": glass, "ior": 1.5}, "water": {"mesh": inner, "ior": 1.33}}
    medium = make_bodies(bodies=bodies, resolution=48, cache=False)
    path = Snell("mesh")(beam(heights), medium)
    assert angle(path.exit_directions, _nested_exit(heights, 0.9, 1.5, 0.7, 1.33)[0]).median() < 0.05


@pytest.mark.parametrize("height", [0.0, 1e-4, 1e-3])
def test_rays_that_begin_just_outside_of_the_triangles_of_a_ball_enter_it(tmp_path: FilePath, height: float) -> None:
    # The triangles lie up to 0.002 below the ball whose normals they have, and the signed distance is that of the ball.
    medium = _mesh_medium(trimesh.creation.icosphere(3, 0.8), tmp_path)
    generator = np.random.default_rng(0)
    normal, direction = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in generator.normal(size=(2, 100, 3)))
    direction -= 1.6 * normal
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = _rays((0.8 + height) * normal, direction, near=0.0)
    path = Snell("mesh")(rays, medium)
    assert path.refracted.all()
    assert angle(path.exit_directions, ball_exits(rays, 0.8, 1.5)).median() < 0.1


def test_rays_that_begin_beside_an_edge_are_inside_of_their_box(tmp_path: FilePath) -> None:
    # Signed distances on a grid round the edge off.
    medium = _mesh_medium(trimesh.creation.box((1, 1, 1)), tmp_path, resolution=16)
    depth = torch.linspace(0.001, 0.02, 20, dtype=torch.float64)
    origins = torch.stack([0.5 - depth, 0.49 - 0 * depth, 0 * depth], -1)
    direction = torch.tensor([math.cos(0.4), 0.0, math.sin(0.4)], dtype=torch.float64)
    path = Snell("mesh")(_rays(origins, direction.expand(20, 3), near=0.0), medium)
    sine = 1.5 * math.sin(0.4)
    expected = torch.tensor([math.sqrt(1 - sine**2), 0.0, sine], dtype=torch.float64)
    torch.testing.assert_close(path.exit_directions, expected.expand(20, 3), atol=1e-9, rtol=0)


@pytest.mark.parametrize("inverted", [False, True])
def test_winding_of_an_open_mesh_does_not_decide_where_rays_begin(tmp_path: FilePath, inverted: bool) -> None:
    """The winding of a mesh with a hole cannot be corrected."""
    dome = trimesh.creation.icosphere(4, 0.8)
    dome.update_faces(dome.triangles_center[:, 2] > -0.6)
    if inverted:
        dome.invert()
    dome.export(tmp_path / "dome.ply")
    medium = make_bodies(str(tmp_path / "dome.ply"), 1.5, resolution=48, accept_open_mesh=True, cache=False)
    rays = _rays([[0.0, 0.0, 1.0], [0.1, 0.0, 0.3]], [[0.0, 0.6, -0.8], [0.6, 0.0, 0.8]], near=0.0)
    assert Snell("mesh")(rays, medium).record.body[:, 0].tolist() == [0, 1]


@pytest.mark.parametrize("num_plates", [2, 3])
def test_plates_in_contact_are_one_plate(tmp_path: FilePath, num_plates: int) -> None:
    plates = [trimesh.creation.box((0.2, 2, 2)).apply_translation((0.2 * i, 0, 0)) for i in range(num_plates)]
    medium = _mesh_medium(trimesh.util.concatenate(plates), tmp_path)
    angles = torch.linspace(0, 40, 9, dtype=torch.float64).deg2rad()
    directions = torch.stack([angles.cos(), angles.sin(), 0 * angles], -1)
    trace = Snell("mesh").trace(_rays(-2 * directions + torch.tensor([0, 0.01, 0.02]), directions), medium)
    assert (trace.num_events == 2).all()
    torch.testing.assert_close(trace.path.exit_directions, directions, atol=1e-6, rtol=0)


def test_bodies_of_equal_index_are_one() -> None:
    radius = grid_points(1.5, 48).norm(dim=-1)
    heights = torch.linspace(-0.7, 0.7, 15, dtype=torch.float64)
    nested = Snell().trace(beam(heights), _grid(torch.stack([radius - 0.8, radius - 0.4]), [1.5, 1.5]))
    single = Snell().trace(beam(heights), _grid(radius[None] - 0.8, [1.5]))
    assert (nested.num_events == 2).all()
    torch.testing.assert_close(nested.path.exit_directions, single.path.exit_directions, atol=1e-8, rtol=0)


def _through_ball(x: np.ndarray, d: np.ndarray, centre: np.ndarray, radius: float, n: float) -> tuple:
    """Refraction into and out of one ball, by vectors."""
    for ratio in (1 / n, n):
        o = x - centre
        b, c = o @ d, o @ o - radius**2
        x = x + d * (-b + (-1 if ratio < 1 else 1) * math.sqrt(b * b - c))
        normal = (x - centre) / radius * (1 if ratio < 1 else -1)
        cosine = -normal @ d
        d = ratio * d + (ratio * cosine - math.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal
    return x, d


@pytest.mark.parametrize("interface", ["mesh", "sdf"])
def test_rays_may_enter_a_body_again(tmp_path: FilePath, interface: str) -> None:
    first, second = np.array([-0.7, 0.0, 0.0]), np.array([0.7, 0.1, 0.0])
    shape = trimesh.util.concatenate(
        [trimesh.creation.icosphere(5, 0.5).apply_translation(centre) for centre in (first, second)]
    )
    medium = _mesh_medium(shape, tmp_path, 1.1, resolution=64)
    heights = torch.linspace(-0.15, 0.15, 7, dtype=torch.float64)
    trace = Snell(interface).trace(beam(heights), medium)  # type: ignore[arg-type]
    assert (trace.num_events == 4).all()
    for row, height in enumerate(heights.tolist()):
        x, d = _through_ball(np.array([-3.0, height, 0]), np.array([1.0, 0, 0]), first, 0.5, 1.1)
        _, d = _through_ball(x, d, second, 0.5, 1.1)
        assert float(angle(trace.path.exit_directions[row], torch.tensor(d))) < 0.03


# --- bookkeeping ---


def test_compiled_paths_match_the_reference() -> None:
    p = grid_points(1.5, 40)
    torus = (((p[..., 0] ** 2 + p[..., 1] ** 2).sqrt() - 0.8) ** 2 + p[..., 2] ** 2).sqrt() - 0.4
    medium = _grid(torch.stack([torus, torus + 0.2]), [1.5, 1.3])
    rays = random_rays(300, 2.4, seed=2, far=9)
    compiled = Snell(max_events=12).trace(rays, medium)
    path, num_events, exceeded = trace_interfaces(rays, medium.double(), 12)
    # Rays that graze a surface differ by rounding.
    same = compiled.num_events == num_events
    assert same.float().mean() > 0.98
    assert (compiled.exceeded == exceeded)[same].all()
    assert num_events.max() >= 6
    assert (num_events == 0).any()
    error = angle(compiled.path.exit_directions, path.exit_directions)[same]
    assert error.median() < 1e-6
    assert error.quantile(0.95) < 1e-2
    assert (compiled.path.refracted == path.refracted)[same].all()


def test_rays_with_too_many_events_are_flagged_and_go_straight_on() -> None:
    # Within a cube of index 2 rays are totally reflected at all faces for ever.
    rays = _rays([[0.1, 0.2, -0.1]], [[0.55, 0.6, 0.58]], 0.0, 20.0)
    distances = RoundedBox(0.75, 0.1).signed_distances(grid_points(1.5, 64))[0]
    for medium in (RoundedBox(0.75, 0.01, 2.0).double(), _grid(distances.movedim(-1, 0), [2.0])):
        trace = Snell(max_events=5).trace(rays, medium)
        assert trace.exceeded.all()
        assert trace.num_events[0] == 5
        assert trace.path.far[0] == 20
    assert not Snell().trace(beam(torch.zeros(1).double()), Ball().double()).exceeded.any()


def test_rays_from_inside_the_glass_leave_it(tmp_path: FilePath) -> None:
    medium = _mesh_medium(trimesh.creation.icosphere(4, 0.8), tmp_path)
    for interface in ("sdf", "mesh"):
        trace = Snell(interface).trace(_rays([[0.0, 0.3, 0.1]], [[0, 1, 0]], 0.0, 4), medium)  # type: ignore[arg-type]
        assert trace.num_events[0] == 1
        i = math.asin(0.1 / 0.8)
        deviation = math.asin(1.5 * math.sin(i)) - i
        # Away from the normal, which leans towards z.
        expected = torch.tensor([0.0, math.cos(deviation), -math.sin(deviation)])
        assert float(angle(trace.path.exit_directions[0], expected)) < 0.02


def test_media_without_a_surface_are_refused() -> None:
    refused("medium=sdf_grid", lambda: Snell()(random_rays(2, 1.0, seed=0, far=9), Luneburg()))
    with pytest.raises(NerfroError, match="interface=mesh needs a medium made of meshes"):
        Snell("mesh")(random_rays(2, 1.0, seed=0, far=9), Ball())
