"""Dispersion: Cauchy's equation, the rainbow and a prism in closed form, and bands as rays of one wavelength."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.paper.eikonal import Eikonal
from tests.closed_forms import Ball, RoundedBox, angle, beam, make_rays, random_rays
from tests.conftest import refused
from tests.reference_tracer import Snell
from tests.samplers.test_snell import _prism

# Water: n_d and Abbe's number.
WATER = 1.333, 55.8


def cauchy(n: float, abbe: float, wavelength: float) -> float:
    """A + B / w^2 through n_d, with n_F - n_C = (n_d - 1) / V."""
    b = (n - 1) / abbe / (486.13**-2 - 656.27**-2)
    return n - b / 587.56**2 + b / wavelength**2


def test_index_follows_cauchys_equation() -> None:
    medium = Ball(0.8, 1.52, abbe=60.0).double()
    lines = {name: float(medium.at_wavelength(w).iors[0]) for name, w in (("d", 587.56), ("F", 486.13), ("C", 656.27))}
    assert lines["d"] == pytest.approx(1.52, abs=1e-12)
    assert 0.52 / (lines["F"] - lines["C"]) == pytest.approx(60, rel=1e-9)
    assert float(medium.at_wavelength(400).iors[0]) == pytest.approx(cauchy(1.52, 60, 400), abs=1e-12)
    assert float(medium.iors[0]) == 1.52, "and the medium itself stays"


@pytest.mark.parametrize(("wavelength", "degrees"), [(680.0, 42.4), (400.0, 40.6)])
def test_angles_of_the_primary_rainbow_match_closed_form(wavelength: float, degrees: float) -> None:
    n = cauchy(*WATER, wavelength)
    i = math.acos(math.sqrt((n * n - 1) / 3)) + 1e-3 * torch.linspace(-1, 1, 201, dtype=torch.float64)
    medium = Ball(0.8, WATER[0], abbe=WATER[1]).double()
    sampler = Snell(branches="all", least_weight=1e-3, wavelengths=[wavelength, 500, 500])
    trace = sampler.trace(beam(0.8 * i.sin()), medium)
    bow = trace.path.exit_directions[(trace.num_events == 3) & (trace.path.record.band == 0)]
    # It returns to where the light came from, 180 degrees less the deviation.
    back = torch.atan2(bow[:, 1].abs(), -bow[:, 0])
    torch.testing.assert_close(back, 4 * torch.asin(i.sin() / n) - 2 * i, atol=1e-9, rtol=0)
    least = math.acos(math.sqrt((n * n - 1) / 3))
    assert float(back.max()) == pytest.approx(4 * math.asin(math.sin(least) / n) - 2 * least, abs=1e-6)
    assert math.degrees(float(back.max())) == pytest.approx(degrees, abs=0.05)


def test_dispersion_of_a_prism_matches_closed_form(tmp_path: FilePath) -> None:
    apex, n, abbe = math.radians(50), 1.5, 40.0
    _prism(apex, 0.9).export(tmp_path / "prism.ply")
    prism = {"mesh": str(tmp_path / "prism.ply"), "ior": n, "abbe": abbe}
    medium = make_bodies(bodies={"prism": prism}, resolution=48, cache=False)
    i = math.radians(45)
    direction = np.array([[math.cos(i - apex / 2), math.sin(i - apex / 2), 0.0]])
    target = np.array([-0.225 * math.tan(apex / 2) * 2, 0.0, 0.1])
    wavelengths = [700.0, 610.0, 550.0, 500.0, 450.0, 400.0]
    path = Snell("mesh", wavelengths=wavelengths)(make_rays(target - 2 * direction, direction, 0.5, 9.0), medium)
    measured = torch.deg2rad(angle(path.exit_directions, torch.tensor(direction))).tolist()
    assert path.record.band.tolist() == [0, 1, 2, 3, 4, 5]
    for found, wavelength in zip(measured, wavelengths, strict=True):
        index, s = cauchy(n, abbe, wavelength), math.sin(i)
        expected = i + math.asin(math.sin(apex) * math.sqrt(index**2 - s**2) - math.cos(apex) * s) - apex
        assert found == pytest.approx(expected, abs=1e-7)
    assert measured == sorted(measured)
    # Two bands for each of red, green and blue.
    half, none = 0.5, 0.0
    assert path.throughput.tolist() == [[half, none, none]] * 2 + [[none, half, none]] * 2 + [[none, none, half]] * 2


@pytest.mark.slow
@pytest.mark.parametrize("branches", ["none", "all"])
def test_every_band_is_traced_as_a_ray_of_its_colour(branches: str) -> None:
    rays, sampler = random_rays(60, 2.0, seed=3, far=6), Snell(branches=branches)  # type: ignore[arg-type]
    medium = RoundedBox(abbe=30.0).double()
    path = sampler(rays, medium)
    total = path.sum_polylines(torch.ones(len(path.s), 3).double())
    torch.testing.assert_close(total, torch.ones_like(total))
    assert (torch.bincount(path.ray)[~path.main_polyline(path.refracted)] == 1).all()
    for band, wavelength in enumerate(sampler.wavelengths):
        single = sampler(rays, RoundedBox(ior=cauchy(1.52, 30, wavelength)).double())
        mine = path[(path.record.band == band) & path.refracted]
        alone = single[single.refracted]
        torch.testing.assert_close(mine.exit_directions, alone.exit_directions, atol=1e-9, rtol=0)
        torch.testing.assert_close(mine.throughput[:, band], alone.throughput[:, 0], atol=1e-9, rtol=0)
        if band == 0:
            main = sampler.trace_main(rays, medium)
            assert main.ray.tolist() == list(range(60))
            torch.testing.assert_close(main.exit_directions, single.main_polyline(single.exit_directions))


def test_gradients_of_all_bands_reach_the_index() -> None:
    def exits(step: Tensor, refine: bool) -> Tensor:
        medium: Bodies = Ball(abbe=30.0).double()
        medium = medium.with_indices(medium.iors + step)
        with torch.no_grad():
            path = sampler(rays, medium)
        path = sampler.replay(path, rays, medium) if refine else path
        return path.exit_directions

    rays, sampler = beam(torch.linspace(-0.6, 0.6, 7).double()), Snell()
    zero = torch.zeros((), dtype=torch.float64)
    found = torch.autograd.functional.jvp(lambda step: exits(step, True), zero, torch.ones_like(zero))[1]
    expected = (exits(zero + 1e-6, False) - exits(zero - 1e-6, False)) / 2e-6
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-6)
    assert found.shape == (21, 3)


def test_learned_index_keeps_its_abbe_number() -> None:
    index = torch.tensor([1.5], dtype=torch.float64, requires_grad=True)
    medium = Ball(abbe=30.0).with_indices(index)
    (gradient,) = torch.autograd.grad(medium.at_wavelength(450).iors.sum(), index)
    assert float(gradient) == pytest.approx((cauchy(1.6, 30, 450) - cauchy(1.5, 30, 450)) / 0.1)


def test_unsupported_dispersion_is_refused() -> None:
    refused("path=snell", lambda: Eikonal()(random_rays(2, 2.0, seed=3, far=6), Ball(abbe=30.0)))
