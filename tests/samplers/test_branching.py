"""Light that splits at surfaces: energy, closed forms, agreement of three tracers, and derivatives of weights."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfro.core.types import Path, Rays
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths import compiled
from nerfro.samplers.paths.replay import smallest_cosine
from tests.closed_forms import Ball, FreeBodies, RoundedBox, Slab, beam, make_rays, random_rays
from tests.reference_tracer import Snell, trace_interfaces
from tests.samplers.nested import NestedBalls, nested_grid, nested_mesh

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])
_rays = functools.partial(random_rays, width=1.6, seed=2, far=6)


def _nested_grid(size: int = 40, iors: Sequence[float] = (1.5, 1.2), **glass: Any) -> Bodies:
    return nested_grid(1.5, size, iors, **glass).float()


def _fresnel(cosine: Tensor, n: float) -> Tensor:
    """Fresnel's share from air into glass, in the form of tangents and sines (r_s = -sin(i - t) / sin(i + t), ...)."""
    i = torch.acos(cosine)
    t = torch.asin(i.sin() / n)
    return 0.5 * (((i - t).sin() / (i + t).sin()).square() + ((i - t).tan() / (i + t).tan()).square())


def _weights(path: Path) -> Tensor:
    return path.throughput[:, 0].double()


@pytest.mark.parametrize("branches", ["first", "all"])
def test_weights_of_a_ray_sum_to_one(branches: str, tmp_path: FilePath) -> None:
    rays = _rays(300)
    media = [(Snell, _nested_grid()), (Snell, RoundedBox().double()), (Snell, nested_mesh(tmp_path))]
    for interface, (_, medium) in zip(("sdf", "sdf", "mesh"), media, strict=True):
        sampler = Snell(interface, branches=branches)  # type: ignore[arg-type]
        trace = sampler.trace(rays, medium)
        total = trace.path.sum_polylines(torch.ones(len(trace.path.s), 3, dtype=torch.float64))
        torch.testing.assert_close(total, torch.ones(len(rays), 3).double(), atol=1e-5, rtol=0)
        assert (_weights(trace.path) >= 0.0199).all()
        counts = torch.bincount(trace.path.ray)
        assert counts[trace.path.main_polyline(trace.path.refracted)].float().mean() > (
            1.8 if branches == "first" else 2
        )
        assert (counts[~trace.path.main_polyline(trace.path.refracted)] == 1).all()


@pytest.mark.parametrize(("n", "reflected", "refracted"), [(1.5, 9.2, 83.6), (1.33, 6.6, 88.2)])
def test_branch_weights_of_a_ball_match_fresnel(n: float, reflected: float, refracted: float) -> None:
    share = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    heights = 0.8 * share.sqrt()  # equal areas of the disc
    trace = Snell(branches="all", least_weight=1e-9).trace(beam(heights), Ball(0.8, n).double())
    weights = _weights(trace.path)
    fresnel = _fresnel((1 - share).sqrt(), n)
    first, twice = (weights[trace.num_events == count] for count in (1, 2))
    torch.testing.assert_close(first, fresnel, atol=1e-7, rtol=0)
    torch.testing.assert_close(twice, (1 - fresnel).square(), atol=1e-7, rtol=0)
    assert 100 * float(first.mean()) == pytest.approx(reflected, abs=0.05)
    assert 100 * float(twice.mean()) == pytest.approx(refracted, abs=0.05)
    # One more reflection inside takes F (1 - F)^2.
    once_inside = weights[trace.num_events == 3]
    torch.testing.assert_close(once_inside, fresnel * (1 - fresnel).square(), atol=1e-7, rtol=0)


@pytest.mark.parametrize("n", [1.33, 1.52])
def test_transmittance_of_a_slab_sums_its_reflections(n: float) -> None:
    rays = make_rays([[0.1, 0.2, -2.0]], [[0, 0, 1]], 0.5, 4.0)
    path = Snell(branches="all", least_weight=1e-12).trace(rays, Slab(0.5, n).double()).path
    through = path.exit_directions[:, 2] > 0
    assert float(_weights(path)[through].sum()) == pytest.approx(2 * n / (n * n + 1), abs=1e-6)


@pytest.mark.parametrize("iors", [[1.5, 1.2], [1.8, 1.8], [1.0, 1.8]])
def test_compiled_branches_match_the_reference(iors: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    medium, rays = _nested_grid(iors=iors, absorption=[1.0, 0.0, 2.0, 0.0, 3.0, 0.0]), _rays(150)
    sampler = Snell(branches="all", least_weight=0.005)
    fast = sampler.trace(rays, medium)
    # The same with too little room for polylines and vertices at first.
    assert torch.bincount(fast.path.ray).max() > 4
    monkeypatch.setattr(compiled, "_MAX_POLYLINES", 2)
    monkeypatch.setattr(compiled, "_MAX_VERTICES", 5)
    again = sampler.trace(rays, medium)
    assert torch.equal(again.path.record.body, fast.path.record.body)
    for name in ("ray", "positions", "directions", "s", "throughput", "radii"):
        assert torch.equal(getattr(again.path, name), getattr(fast.path, name))
    assert torch.equal(again.num_events, fast.num_events)
    path, num_events, exceeded = trace_interfaces(rays, medium.double(), 16, sampler.branching)
    # Rays that graze a surface, or split just or just not, differ by rounding.
    same = torch.bincount(fast.path.ray) == torch.bincount(path.ray)
    assert same.float().mean() > 0.98
    one, other = same[fast.path.ray], same[path.ray]
    assert torch.equal(fast.num_events[one], num_events[other])
    assert torch.equal(fast.exceeded[one], exceeded[other])
    torch.testing.assert_close(fast.path.throughput[one], path.throughput[other], atol=1e-5, rtol=0)
    assert torch.equal(fast.path.refracted[one], path.refracted[other])

    def values(path: Path) -> Tensor:
        left = medium.with_absorption(path).whole_transmittance()
        return torch.cat([path.exit_directions, left], -1)

    error = (values(fast.path)[one] - values(path)[other]).norm(dim=-1)
    assert error.median() < 1e-6
    assert error.quantile(0.95) < 1e-4


@pytest.mark.parametrize("medium", [_nested_grid(), NestedBalls()], ids=["compiled", "torch"])
def test_absorbing_body_of_index_one_adds_no_event(medium: Bodies) -> None:
    rays, sampler = _rays(100), Snell(branches="first")
    iors = torch.tensor([1.0, 1.5]).double().requires_grad_()
    results = []
    for outer in (0.0, 1.0):
        dyed = medium.with_indices(iors).with_absorption_coefficients(torch.tensor([[outer] * 3, [0.0] * 3]))
        path, num_events, _ = sampler.trace(rays, dyed)
        refined, steady = sampler.replay(path, rays, dyed), sampler.steady(path, dyed)
        (gradient,) = torch.autograd.grad((refined.throughput * refined.exit_directions)[steady].sum(), iors)
        results.append((path.throughput, path.exit_directions, num_events, steady, gradient[1]))
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected)


def test_first_polyline_of_a_ray_is_transmitted() -> None:
    rays, medium = _rays(300), _nested_grid()
    single, split = Snell()(rays, medium), Snell(branches="all")(rays, medium)
    first = split.main_polyline(split.exit_directions)
    same = (first - single.exit_directions).norm(dim=-1) < 1e-6
    # At grazing rays, less than 2 % pass: they are reflected whole.
    assert same.float().mean() > 0.95
    assert torch.equal(Snell(branches="first", least_weight=0.6)(rays, medium).ray, torch.arange(len(rays)))


@pytest.mark.parametrize("tracer", ["grid", "closed form", "mesh"])
def test_main_polylines_equal_the_first_of_all_polylines(tracer: str, tmp_path: FilePath) -> None:
    rays, medium = (
        _rays(300),
        {"grid": _nested_grid, "closed form": NestedBalls}.get(tracer, lambda: None)(),
    )
    medium = medium or nested_mesh(tmp_path)
    sampler = Snell("mesh" if tracer == "mesh" else "sdf", branches="all")
    every, main = sampler(rays, medium), sampler.trace_main(rays, medium)
    assert main.num_rays == len(main.s) == len(rays) < len(every.s)
    for name in ("throughput", "exit_directions"):
        assert torch.equal(getattr(main, name), every.main_polyline(getattr(every, name)))


def test_weights_of_omitted_branches_are_added_to_the_others() -> None:
    heights = torch.tensor([0.0, 0.6, 0.799]).double()
    path = Snell(branches="all", least_weight=0.1)(beam(heights), Ball(0.8, 1.5).double())
    assert torch.bincount(path.ray).tolist() == [1, 1, 2]
    grazing = _weights(path)[-2:]
    assert float(grazing[1]) == pytest.approx(float(_fresnel((1 - (heights[-1:] / 0.8) ** 2).sqrt(), 1.5)))
    for least in (0.3, 0.03, 0.003):
        counts = torch.bincount(Snell(branches="all", least_weight=least)(_rays(300), Ball().double()).ray)
        assert counts.max() <= 1 / least


@pytest.mark.parametrize("what", ["index", "origin"])
def test_derivatives_of_replayed_weights_match_traced_weights(what: str) -> None:
    rays, sampler = _rays(60), Snell(branches="all", least_weight=1e-3)

    def traced(step: Tensor) -> tuple[Path, Rays, Bodies]:
        medium = NestedBalls()
        medium = medium.with_indices(medium.iors + (step if what == "index" else 0))
        moved = Rays(rays.origins + (step if what == "origin" else 0), *list(vars(rays).values())[1:])
        with torch.no_grad():
            path, _, _ = trace_interfaces(moved, medium, 16, sampler.branching)
        return path, moved, medium

    def refined(step: Tensor) -> Tensor:
        return sampler.replay(*traced(step)).throughput[:, 0]

    zero = torch.zeros((), dtype=torch.float64)
    found = torch.autograd.functional.jvp(refined, zero, torch.ones_like(zero))[1]
    h = 1e-6
    sides = [traced(torch.tensor(sign * h).double())[0] for sign in (1, -1)]
    path, _, medium = traced(zero)
    assert all(torch.equal(side.ray, path.ray) for side in sides)
    expected = (sides[0].throughput - sides[1].throughput)[:, 0] / (2 * h)
    steady = smallest_cosine(path, medium) > 0.15
    assert steady.sum() > 100
    torch.testing.assert_close(found[steady], expected[steady], rtol=1e-4, atol=1e-7)
    assert float(expected[steady].abs().max()) > 0.05


class CementedHalves(FreeBodies):
    """A ball of two glasses: the second one fills the half x > 0 and reaches a rounding error beyond the first one."""

    def __init__(self) -> None:
        super().__init__([1.5, 1.7], 0.02, BOX.double())
        self.radii = torch.tensor([0.8, 0.8 + 2e-7], dtype=torch.float64)

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        radius = positions.norm(dim=-1, keepdim=True)
        curved, plane = radius - self.radii, -positions[..., :1]
        is_plane = torch.cat([torch.zeros_like(plane), plane], -1) > curved
        is_plane[..., 0] = False
        axis = positions.new_tensor([-1.0, 0, 0])
        gradients = torch.where(is_plane[..., None], axis, (positions / radius)[..., None, :])
        return torch.where(is_plane, plane, curved), gradients


@pytest.mark.parametrize("what", ["radius of the first", "radius of the second", "iors"])
def test_gradients_at_touching_bodies_belong_to_the_intersected_body(what: str) -> None:
    rays, sampler = _rays(100), Snell(branches="all", least_weight=1e-3)

    def moved(step: Tensor) -> CementedHalves:
        medium = CementedHalves()
        if what == "iors":
            return medium.with_indices(medium.iors + step)
        medium.radii = medium.radii + step * torch.tensor([what.endswith("first"), what.endswith("second")])
        return medium

    def traced(step: float) -> Path:
        return trace_interfaces(rays, moved(torch.tensor(step).double()), 16, sampler.branching)[0]

    def values(path: Path) -> Tensor:
        column = torch.arange(18).clamp(max=path.s.shape[1] - 1)
        every = (path.positions[:, column], path.directions[:, column], path.throughput)
        return torch.cat([tensor.flatten(1).double() for tensor in every], -1)

    # As training has it: in single precision, in which the nearest surface is either one.
    path = traced(0.0)
    names = ("positions", "directions", "s", "radii", "throughput")
    single = replace(path, **{name: getattr(path, name).float() for name in names})

    def refined(step: Tensor) -> Tensor:
        medium = moved(step)
        medium.radii, medium.box = medium.radii.float(), medium.box.float()
        return values(sampler.replay(single, rays.to(torch.float32), medium))

    zero = torch.zeros((), dtype=torch.float64)
    found = torch.autograd.functional.jvp(refined, zero, torch.ones_like(zero))[1]
    h = 1e-8
    after, before = traced(h), traced(-h)
    assert torch.equal(after.record.surface_body, before.record.surface_body)
    expected = (values(after) - values(before)) / (2 * h)
    error = (found - expected).norm(dim=-1) / (1 + expected.norm(dim=-1))
    steady = smallest_cosine(path, moved(zero)) > 0.15
    reflected = (path.record.surface_body == 2) & (path.record.body == path.record.body.roll(1, 1))
    assert (steady & reflected.any(-1)).sum() > 50
    assert error[steady].max() < 1e-2


# --- rays with all their polylines ---


def test_selected_and_joined_rays_keep_all_polylines() -> None:
    path = Snell(branches="all")(_rays(20), Ball().double())
    rows = torch.tensor([7, 2, 2, 11])
    chosen = path.select_rays(rows)
    assert chosen.num_rays == 4
    for place, ray in enumerate(rows.tolist()):
        assert torch.equal(chosen.positions[chosen.ray == place], path.positions[path.ray == ray])
        assert torch.equal(chosen.throughput[chosen.ray == place], path.throughput[path.ray == ray])
    both = Path.joined([chosen, Snell()(_rays(3), Ball().double())])
    assert both.num_rays == 7
    assert both.ray[-3:].tolist() == [4, 5, 6]
    torch.testing.assert_close(both.sum_polylines(torch.ones(len(both.s), 3).double()), torch.ones(7, 3).double())
