"""A dent inside the outlines, from photographs of what is seen through it."""

import functools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.capture import refinement
from nerfro.capture.object_errors import ObservedLight
from nerfro.capture.refinement import (
    DescentStage,
    Refined,
    RefinementProblem,
    RefinementSettings,
    refine,
    refine_surface,
)
from nerfro.capture.surroundings import (
    Observations,
    Pixels,
    Room,
    Surroundings,
    divide_pixels,
    learn_surroundings,
    panorama_of,
)
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.types import Exits
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.ball_photographs import BOX, RADIUS, cameras, mesh, photographs_of, save, sky, solid
from tests.closed_forms import grid_points, sampled
from tests.conftest import Runner

DEPTH, WIDTH, AXIS = 0.05, 0.12, torch.tensor([0.6, 0.0, 0.8])


def dented() -> Bodies:
    """The ball, flattened on one side."""
    ball = solid([1.5])
    directions = grid_points(0.9, len(ball.grids[0].distances))
    directions = torch.nn.functional.normalize(directions, dim=-1)
    dent = DEPTH * torch.exp((directions @ AXIS - 1) / WIDTH)
    return sampled([ball.grids[0].distances + dent], BOX, [1.5], 0.01)


SHORT = RefinementSettings((DescentStage(150, 5e-4, (3.0, 1.0)), DescentStage(50, 1e-4, (0.0, 0.0))), 2000, (8, 16))


ABSORPTION = torch.tensor([[0.2, 0.6, 1.4]])


@functools.cache
def shown(reflects: bool = False, absorbs: bool = False) -> tuple[Silhouettes, Pixels, Surroundings]:
    """Outlines of the dented ball, pixels that it fills, and what is around it."""
    outlines = mesh_silhouettes(refinement._project_onto(mesh(), dented()), cameras(), 1)
    silhouettes = Silhouettes.of(cameras(), outlines.float())
    sampler = Snell(branches="all", least_weight=0.02) if reflects else Snell()
    body = dented().with_absorption_coefficients(ABSORPTION) if absorbs else dented()
    beside, through = divide_pixels(photographs_of(body, sampler=sampler), mesh())
    return silhouettes, through, learn_surroundings(beside, mesh(), False)


def problem(start: Bodies, reflects: bool = False) -> RefinementProblem:
    return RefinementProblem(mesh(), start, *shown(reflects))


def refined(
    start: Bodies, settings: RefinementSettings = SHORT, learn_index: bool = False, reflects: bool = False
) -> Refined:
    return refine_surface(problem(start, reflects), learn_index, settings=settings)


def degrees_off(medium: Bodies, num_views: int = 6) -> float:
    """Median angle between exit directions and the right ones, of rays that the dent turns by a degree or more."""
    errors, right = [], dented()
    for view in range(num_views):
        rays = cameras().image_rays(view)
        ours, ball, true = (Snell()(rays, m).exit_directions for m in (medium, solid([1.5]), right))
        turned = (ball - true).norm(dim=-1) > 0.017
        errors.append((ours - true)[turned].norm(dim=-1))
    return float(torch.rad2deg(torch.cat(errors)).median())


@pytest.mark.slow
def test_refinement_recovers_a_dent_despite_a_wrong_index() -> None:
    before = solid([1.49])
    found = refined(before, learn_index=True)
    assert degrees_off(found.medium) < 0.4 * degrees_off(before)
    assert found.errors[-1] < 0.6 * found.errors[0]
    # The mesh is the medium's surface, dented where the ball was.
    vertices = torch.from_numpy(found.mesh.vertices).float()
    assert found.medium.signed_distances(vertices)[0].abs().max() < 1e-3
    radius = vertices.norm(dim=-1)
    assert radius[(vertices / radius[:, None]) @ AXIS > 0.97].mean() < RADIUS - 0.3 * DEPTH
    assert abs(radius[(vertices / radius[:, None]) @ AXIS < 0].mean() - RADIUS) < 0.1 * DEPTH


@pytest.mark.slow
def test_refinement_of_a_reflecting_body_recovers_a_dent() -> None:
    before = solid([1.5])
    found = refined(before, reflects=True)
    assert degrees_off(found.medium) < 0.4 * degrees_off(before)
    assert found.errors[-1] < 0.6 * found.errors[0]


@pytest.mark.slow
def test_refinement_of_an_absorbing_body_recovers_a_dent() -> None:
    silhouettes, through, surroundings = shown(absorbs=True)
    before = solid([1.5]).with_absorption_coefficients(ABSORPTION)
    found = refine_surface(RefinementProblem(mesh(), before, silhouettes, through, surroundings), settings=SHORT)
    assert degrees_off(found.medium) < 0.4 * degrees_off(before)
    assert found.medium.absorption == pytest.approx(ABSORPTION)


@pytest.mark.parametrize("reflects", [False, True])
def test_partial_reflections_are_followed_if_photographs_have_them(reflects: bool) -> None:
    descent = refinement._Descent(problem(dented(), reflects), False, SHORT)
    assert (descent.sampler.branching.max_split_events > 0) == reflects
    assert descent.initial_errors.mean() < 0.01, "the body is the true one"


@pytest.mark.parametrize(("absorbs", "measured"), [(True, ABSORPTION), (False, 0 * ABSORPTION + 0.3)])
def test_measured_absorption_is_used_if_it_explains_validation_pixels(absorbs: bool, measured: Tensor) -> None:
    light = ObservedLight(measured, 1.0, torch.full((3,), 2.0))
    given = RefinementProblem(mesh(), dented(), *shown(absorbs=absorbs), light)
    descent = refinement._Descent(given, False, SHORT)
    assert (descent.medium().absorption is not None) == absorbs
    assert descent.surroundings.clipped_radiance.tolist() == [2.0 if absorbs else 1.0] * 3
    assert descent.initial_errors.mean() < 0.01, "the surface is the true one"


@torch.no_grad()
def test_dispersive_bodies_are_refined_at_one_wavelength() -> None:
    glass = sampled(solid([1.5]).grids[0].distances[None], BOX, [1.5], 0.01, abbe=30.0)
    assert glass.disperses
    descent = refinement._Descent(problem(glass), True, SHORT)
    descent.begin(descent.values())
    descent.step(SHORT.stages[0], 0)
    assert descent.iors.grad is not None


@pytest.mark.slow
def test_refinement_keeps_a_correct_surface() -> None:
    before = dented()
    found = refined(before)
    assert found.medium is before
    assert len(found.errors) > 2  # others were tried


def test_blurred_stages_without_gain_are_undone_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would spoil an accurate surface, from which the stage with sharp surroundings starts."""
    followed = []

    def step(descent: refinement._Descent, stage: DescentStage, number: int) -> None:
        followed.append(stage)
        descent.iors += 0.01

    # The first stage gains less than 1 %, and the last one starts where the first one started.
    monkeypatch.setattr(refinement._Descent, "step", step)
    monkeypatch.setattr(refinement._Descent, "validation_error", lambda _, medium: 1.51 - 0.2 * float(medium.iors[0]))
    stages = DescentStage(1, 1.0, (3.0, 1.0)), DescentStage(1, 1.0, (1.0, 0.5)), DescentStage(1, 1.0, (0.0, 0.0))
    settings = RefinementSettings(stages, smoothings=(), validate_every=1, max_overlap_loss=math.inf)
    found = refined(solid([1.5]), settings)
    assert followed == [stages[0], stages[2]]
    assert found.steps == [0, 0, 1, 2, 2]
    assert found.errors[2] == found.errors[3]


def test_smoothing_is_selected_by_the_validation_error() -> None:
    right = dented()
    rough = 0.004 * torch.randn(right.grids[0].distances.shape, generator=torch.Generator().manual_seed(0))
    start = right.grown(rough)
    found = refined(start, settings=RefinementSettings(stages=(), smoothings=(0.02, 0.04, 0.3)))
    assert degrees_off(found.medium) < 0.6 * degrees_off(start)
    assert found.steps == [0, 0, 0]
    assert found.errors[1] < 0.9 * found.errors[0]


def test_surface_that_loses_overlap_with_the_masks_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement._Descent, "validation_error", lambda *_: 0.0)
    before, shrinking = dented(), RefinementSettings(stages=(), smoothings=(0.3,))
    assert refined(before, shrinking).medium is before
    assert refined(before, replace(shrinking, max_overlap_loss=math.inf)).medium is not before


def test_triangles_longer_than_voxels_are_displaced_between_their_vertices(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """All vertices of a cube are corners, and the dent is in the middle of a side."""
    corners = trimesh.creation.box((1.0, 1.0, 1.0))
    cube = TriangleMesh(np.asarray(corners.vertices), np.asarray(corners.faces))
    points = grid_points(0.9, 33)
    distances = (points.abs() - 0.5).amax(-1)
    solid_cube = sampled([distances], BOX, [1.5], 0.01)
    middle = torch.tensor([0.0, 0.0, 0.5])
    hollow = solid_cube.grown(-DEPTH * torch.exp(-(points - middle).square().sum(-1) / (2 * 0.15**2)))
    _, through, surroundings = shown()
    observations = Observations(photographs_of(solid([1.5])), cube, False)
    observations.__dict__.update(through=through, surroundings=surroundings)
    monkeypatch.setattr(refinement, "observed_light", lambda *_: None)

    def refined_to(medium: Bodies) -> TriangleMesh:
        def found(problem: RefinementProblem, *_: object) -> Refined:
            moved = problem.mesh if medium is solid_cube else refinement._project_onto(problem.mesh, medium)
            return Refined(moved, medium, [0, 1], [1.0, 0.5])

        monkeypatch.setattr(refinement, "refine_surface", found)
        return refine(observations, cube, solid_cube, None, False, tmp_path)

    dented_cube = refined_to(hollow)
    nearest = np.linalg.norm(dented_cube.vertices - [0, 0, 0.5 - DEPTH], axis=1).min()
    assert nearest < 0.01
    assert dented_cube.is_closed
    assert refined_to(solid_cube) is cube, "the given mesh, if it is not improved"


def test_reconstructed_room_is_independent_of_earlier_random_numbers() -> None:
    first = Room(mesh().bounds, 3.0)
    torch.rand(1000)
    state = torch.get_rng_state()
    second = Room(mesh().bounds, 3.0)
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), state)


class PaintedShell(Room):
    """The sky's colours on a ball around the object, just beyond the cameras."""

    RADIUS = 3.2

    def __init__(self) -> None:
        Background.__init__(self)

    def seen(self, exits: Exits, draws: Draws | None = None) -> tuple[Tensor, Tensor]:
        assert exits.positions is not None
        along = (exits.positions * exits.directions).sum(-1)
        away = (along**2 - exits.positions.square().sum(-1) + self.RADIUS**2).sqrt() - along
        return sky((exits.positions + away[:, None] * exits.directions) / self.RADIUS), away


def test_panorama_matches_the_room_along_every_ray() -> None:
    room = PaintedShell()
    middle = torch.tensor([0.1, -0.2, 0.05])
    backdrop = panorama_of(room, solid([1.5]), middle)
    generator = torch.Generator().manual_seed(0)
    positions = (torch.rand(500, 3, generator=generator) - 0.5).requires_grad_()
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=-1).requires_grad_()
    lines = Exits(directions, positions)
    assert (backdrop(lines) - room(lines)).abs().max() < 5e-3
    ours, right = (torch.autograd.grad(b(lines).sum(), [directions, positions]) for b in (backdrop, room))
    for one, other in zip(ours, right, strict=True):
        across = other - (other * directions).sum(-1, keepdim=True) * directions
        error = (one - other - ((one - other) * directions).sum(-1, keepdim=True) * directions).norm(dim=-1)
        assert error.median() < 0.1 * across.norm(dim=-1).median()


@pytest.fixture
def preprocess(tmp_path: Path, run_here: Runner) -> Callable:
    """Refine the ball's mesh by photographs of another medium; returns the folder, and what was printed."""

    def run(*overrides: str, medium: Bodies | None = None, ior: float | None = 1.5) -> tuple[Path, str]:
        save(photographs_of(dented() if medium is None else medium), tmp_path)
        out = tmp_path / "out"
        options = [f"data.root={tmp_path}", f"mesh={tmp_path / 'mesh.ply'}", f"out={out}", "data.near=0.5"]
        options += ["refine=true", "medium.cache=false", "medium.resolution=41"]
        options += [] if ior is None else [f"medium.ior={ior}"]
        return out, run_here("preprocess", *options, *overrides).out

    return run


@pytest.mark.slow
def test_preprocess_writes_the_refined_surface(preprocess: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = RefinementSettings((DescentStage(75, 5e-4, (3.0, 1.0)),), 2000, (8, 16))
    monkeypatch.setattr(refinement, "RefinementSettings", lambda: quick)
    out, printed = preprocess("room=false")
    assert "surface refined and used" in printed
    assert f"scene={out / 'scene.json'}" in printed
    displacement = np.linalg.norm(load_mesh(out / "mesh.ply").vertices, axis=1) - RADIUS
    assert np.abs(displacement).max() > 1e-3
    figures = json.loads((out / "refinement.json").read_text())
    assert min(figures["validation_error"]) < 0.8 * figures["validation_error"][0]


def test_failed_refinement_keeps_the_surface(preprocess: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing_known(*_: object) -> Refined:
        raise NerfroError("no pixel shows known surroundings")

    monkeypatch.setattr(refinement, "refine_surface", nothing_known)
    out, printed = preprocess()
    assert "surface unchanged" in printed
    given = load_mesh(out.parent / "mesh.ply")
    np.testing.assert_allclose(load_mesh(out / "mesh.ply").vertices, given.vertices, atol=1e-6)


@pytest.mark.slow
def test_refinement_starts_with_the_estimated_index(preprocess: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Bodies] = []

    def kept(problem: RefinementProblem, *_: object) -> Refined:
        begun.append(problem.medium)
        raise NerfroError("enough is known")

    monkeypatch.setattr(refinement, "refine_surface", kept)
    preprocess("room=false", medium=solid([1.33]), ior=None)
    assert begun[0].iors.tolist() == [pytest.approx(1.33, rel=0.005)]
