"""Absorption along paths: the Beer-Lambert law in closed form, gradients, and refused settings."""

from dataclasses import replace
from pathlib import Path as FilePath

import pytest
import torch
from torch import Tensor

from nerfro.core.compositing import composite
from nerfro.core.types import FieldValues, Path, Rays
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.eikonal import Eikonal
from nerfro.samplers.points.stratified import point_samples
from nerfro.testing import example_components, example_rays
from tests.closed_forms import Ball, beam, random_rays
from tests.conftest import refused
from tests.reference_tracer import Snell
from tests.samplers.nested import NestedBalls, nested_grid, nested_mesh

SIGMA = [0.3, 1.0, 2.5]


def _path(heights: list[float]) -> Path:
    medium = Ball(0.8, 1.5, absorption=SIGMA).double()
    return medium.with_absorption(Snell()(beam(torch.tensor(heights, dtype=torch.float64)), medium))


def test_background_behind_a_ball_is_attenuated_by_its_chord() -> None:
    heights = torch.tensor([0.0, 0.3, 0.7, 0.9], dtype=torch.float64)
    path = _path(heights.tolist())
    chord = torch.where(heights < 0.8, 1.6 * (1 - (heights / 1.2).square()).sqrt(), 0.0)
    expected = torch.exp(-chord[:, None] * torch.tensor(SIGMA, dtype=torch.float64))
    torch.testing.assert_close(path.whole_transmittance(), expected)
    assert (expected[-1] == 1).all()


def test_content_inside_is_attenuated_by_the_glass_before_it() -> None:
    path = _path([0.0])
    # From 3 units before the middle to the surface; then 0.5 in glass; then behind the ball.
    s = torch.tensor([[1.0, 2.2, 2.7, 3.8, 5.0]], dtype=torch.float64)
    depth = torch.tensor([0, 0, 0.5, 1.6, 1.6], dtype=torch.float64)
    expected = torch.exp(-depth[:, None] * torch.tensor(SIGMA, dtype=torch.float64))
    torch.testing.assert_close(path.transmitted(s)[0], expected)
    samples = point_samples(path, s)
    density = torch.tensor([[0.0, 0, 1e6, 0, 0]], dtype=torch.float64)
    seen = composite(samples, FieldValues(density, torch.ones(1, 5, 3)), torch.ones(1, 3), path)
    torch.testing.assert_close(seen.radiance, expected[None, 2], rtol=1e-6, atol=0)
    empty = composite(samples, FieldValues(0 * density, torch.ones(1, 5, 3)), torch.ones(1, 3), path)
    torch.testing.assert_close(empty.radiance, expected[None, -1], rtol=1e-6, atol=0)


def test_reflection_at_the_outside_of_a_ball_is_not_tinted() -> None:
    medium = Ball(0.8, 1.5, absorption=SIGMA).double()
    path = medium.with_absorption(Snell(branches="first")(beam(torch.tensor([0.5]).double()), medium))
    through, reflected = path.whole_transmittance()
    assert (through < 0.9).all()
    assert (reflected == 1).all()


@pytest.mark.parametrize("tracer", ["closed form", "grid", "mesh"])
def test_absorption_does_not_depend_on_a_change_of_the_index(tracer: str, tmp_path: FilePath) -> None:
    sigma = torch.tensor([[0.5, 1.0, 0.0], [2.0, 0.0, 1.0]], dtype=torch.float64)
    media = {"closed form": NestedBalls, "grid": lambda: nested_grid(1.2, 33, [1.5, 1.2])}
    medium = nested_mesh(tmp_path) if tracer == "mesh" else media[tracer]()
    medium, rays = medium.with_absorption_coefficients(sigma), random_rays(200, 1.0, seed=0, far=6)
    sampler = Snell("mesh" if tracer == "mesh" else "sdf")

    def left(*iors: float) -> Tensor:
        path = medium.with_absorption(sampler(rays, medium.with_indices(torch.tensor(iors))))
        return path.whole_transmittance()

    for outer, inner in ((1.0, 1.0), (1.5, 1.5), (1.0, 1.5)):
        torch.testing.assert_close(left(outer, inner), left(outer + 1e-6, inner + 2e-6), atol=1e-4, rtol=0)
    chords = torch.stack([_chord(rays, [0.0, 0, 0], 0.8), _chord(rays, [0.2, 0.1, 0], 0.4)], -1)
    expected = torch.exp(-(chords @ sigma - chords[:, 1:] * sigma[0]))
    # An icosphere lies inside its ball, which shortens chords near the rim most.
    assert (left(1.0, 1.0) - expected).abs().quantile(0.9) < (0.02 if tracer == "mesh" else 1e-3)


def _chord(rays: Rays, centre: list[float], radius: float) -> Tensor:
    """Lengths of straight rays in a ball."""
    distance = torch.linalg.cross(rays.origins - torch.tensor(centre), rays.directions).norm(dim=-1)
    return 2 * (radius**2 - distance.square()).clamp(min=0).sqrt()


def test_absorption_has_gradients_without_new_paths() -> None:
    model = RefractiveModel(replace(example_components(), medium=Ball(learn=["absorption"]), path_sampler=Snell()))
    assert not model.paths_learn, "paths may be traced ahead"
    absorption = "bodies.object.material.absorption"
    parameter = model.parameters_by_name()[absorption]
    with torch.no_grad():
        path = model.trace(example_rays())
    renderings = model.render_path(model.trace(example_rays(), path))
    (gradient,) = torch.autograd.grad(renderings[-1].radiance.sum(), parameter)
    assert (gradient != 0).all()
    names = [f"{absorption}.{colour}" for colour in ("red", "green", "blue")]
    assert model.scene.measurements() == dict.fromkeys(names, pytest.approx(0.02 / model.scene.medium.radius))


@pytest.mark.parametrize("radius", [0.8 / 1024, 0.8 * 1024])
def test_learned_absorption_is_independent_of_the_world_unit(radius: float) -> None:
    one, other = (Ball(size, learn=["absorption"]).materials[0] for size in (0.8, radius))
    for material in (one, other):
        (gradient,) = torch.autograd.grad(material.absorption.sum(), material.learned()["absorption"])
        with torch.no_grad():
            material.learned()["absorption"] += 0.05 * gradient.sign()  # a step of Adam
    assert torch.equal(one.absorption * 0.8, other.absorption * radius)


def test_learned_absorption_starts_from_a_given_one_of_any_size() -> None:
    for coefficient in (0.1, 30.0, 3000.0):
        started = Ball(0.8, absorption=[coefficient], learn=["absorption"]).absorption
        torch.testing.assert_close(started, torch.full((1, 3), coefficient))


def test_absorption_is_given_for_all_bodies_or_for_each() -> None:
    torch.testing.assert_close(Ball(absorption=[0.4]).absorption, torch.full((1, 3), 0.4))
    assert Ball().absorption is None
    start = Ball(absorption=SIGMA, learn=["absorption"]).absorption
    torch.testing.assert_close(start, torch.tensor([SIGMA]))
    refused("path=snell", lambda: Eikonal()(example_rays(), Ball(absorption=[0.1])))
