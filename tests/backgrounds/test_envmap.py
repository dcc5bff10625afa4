"""The environment map and its cube map: learning, files, conventions, and the compiled lookup."""

import itertools
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from nerfro.backgrounds import cube_map
from nerfro.backgrounds.envmap import EnvironmentMap, Observed
from nerfro.core.light import to_srgb
from nerfro.core.types import Exits
from nerfro.files import lat_long
from nerfro.files.images import save_png
from tests.conftest import refused
from tests.gradients import require_equal_gradients


def random_directions(num: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)


def smooth_sky(directions: torch.Tensor) -> torch.Tensor:
    """A different smooth function in each channel, within [0.1, 0.9] and with no symmetry."""
    x, y, z = directions.unbind(-1)
    return 0.5 + 0.2 * torch.stack([x + 0.5 * y, y - 0.7 * z * x, z + 0.4 * x * y], dim=-1)


def test_environment_map_starts_grey() -> None:
    assert torch.allclose(EnvironmentMap()(Exits(random_directions(10))), torch.full((10, 3), 0.25))


def test_fitted_texels_are_the_mean_of_all_rays_and_one_zero_residual() -> None:
    background, generator = EnvironmentMap([4]), torch.Generator().manual_seed(0)
    directions = cube_map.texel_directions(4)
    radiance, weights = torch.rand(3, 96, 3, generator=generator), torch.rand(3, 96, generator=generator)
    past = torch.zeros(96)
    for values, of_ray in zip(radiance, weights, strict=True):
        background.fit(Observed(directions, values, values >= 1, of_ray, torch.zeros(96)), past)
    torch.testing.assert_close(past, weights.sum(0))
    raw = torch.log(torch.expm1(radiance.sqrt() * 2 * math.log(2)))  # of a texel that one ray has seen
    expected = (weights[..., None] * raw).sum(0) / (weights.sum(0) + 1)[:, None]
    torch.testing.assert_close(background.texels.detach(), expected, rtol=1e-4, atol=1e-5)


def test_fit_has_the_finest_level_in_memory_as_few_times_as_possible() -> None:
    background, directions = EnvironmentMap([4, 256]), random_directions(1000)
    sky, widths = smooth_sky(directions), torch.zeros(1000)
    observed, past = Observed(directions, sky, sky >= 1, torch.ones(1000), widths), torch.zeros(len(background.texels))
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        background.fit(observed, past)
    assert profile.profiler is not None
    events = [event for event in profile.profiler.kineto_results.events() if event.name() == "[memory]"]
    changes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    assert changes
    assert max(itertools.accumulate(changes)) < 1.2 * background.texels.nbytes


def test_wide_cones_do_not_change_fine_levels() -> None:
    background, directions = EnvironmentMap([4, 8]), random_directions(50)
    width = torch.full((50,), 1.1 * math.radians(90 / 4))  # two texels of the fine level are 90 / 4 degrees wide
    sky = smooth_sky(directions)
    background.fit(Observed(directions, sky, sky >= 1, torch.ones(50), width), torch.zeros(480))
    coarse, fine = background.texels.split(background.levels.sizes)
    assert coarse.any()
    assert not fine.any()


def test_saturated_radiance_is_a_lower_bound() -> None:
    background, directions, none = EnvironmentMap([4]), cube_map.texel_directions(4), torch.zeros(96)
    for radiance in (4.0, 1.0):  # a lamp, and a photograph in which the lamp is saturated
        seen = torch.full((96, 3), radiance)
        background.fit(Observed(directions, seen, seen == 1, torch.full((96,), 1e6), none), none)
    torch.testing.assert_close(background(Exits(directions)).detach(), torch.full((96, 3), 4.0), rtol=1e-4, atol=0)


@pytest.mark.parametrize("levels", [([4, 8, 16, 32], None), ([4, 8], [16, 32])])
def test_fit_learns_a_sky_from_few_rays(levels: tuple[list[int], list[int] | None]) -> None:
    background, directions, others = EnvironmentMap(*levels), random_directions(2000), random_directions(2000, 9)
    sky = smooth_sky(directions)
    observed = Observed(directions, sky, sky >= 1, torch.ones(2000), torch.zeros(2000))
    background.fit(observed, torch.zeros(background.levels.num_texels))
    error = (background(Exits(others)) - smooth_sky(others)).detach().square().mean().sqrt()
    assert error < 0.02  # the standard deviation of the sky is 0.15


def test_fitted_levels_add_to_the_other_levels_without_gradient() -> None:
    together, apart, directions = EnvironmentMap([4, 8, 16]), EnvironmentMap([4], [8, 16]), random_directions(50)
    torch.nn.init.normal_(together.texels)
    assert set(together.state_dict()) == {"texels"}, "checkpoints of earlier versions have no fitted levels"
    state = together.state_dict()["texels"].split([96, 6 * (64 + 256)])
    apart.load_state_dict({"texels": state[0], "fitted_texels": state[1]})
    torch.testing.assert_close(apart(Exits(directions)), together(Exits(directions)))
    apart(Exits(directions)).sum().backward()
    together(Exits(directions)).sum().backward()
    torch.testing.assert_close(apart.texels.grad, together.texels.grad[:96])
    image = torch.rand(32, 64, 3)
    for sky in (together, apart):
        sky.set_lat_long(image)
    torch.testing.assert_close(apart(Exits(directions)), together(Exits(directions)))


def test_sum_of_levels_learns_a_sky_from_few_rays() -> None:
    # 300 steps of 64 rays see 19200 directions; the finest level alone has 6144 texels and leaves gaps.
    errors = []
    for resolutions in ([4, 8, 16, 32], [32]):
        torch.manual_seed(0)
        background = EnvironmentMap(resolutions)
        optimizer = torch.optim.Adam(background.parameters(), lr=0.02, eps=1e-15)
        for step in range(300):
            optimizer.param_groups[0]["lr"] = 0.02 * 0.05 ** (step / 300)
            directions = torch.nn.functional.normalize(torch.randn(64, 3), dim=-1)
            loss = (to_srgb(background(Exits(directions))) - smooth_sky(directions)).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        unseen = random_directions(2000, seed=9)
        errors.append(float((to_srgb(background(Exits(unseen))) - smooth_sky(unseen)).detach().square().mean().sqrt()))
    pyramid, single = errors
    assert pyramid < 0.01
    assert pyramid < 0.2 * single


def test_gradient_of_directions_matches_autograd() -> None:
    background = EnvironmentMap([1, 4, 8])
    torch.nn.init.normal_(background.texels)
    directions = random_directions(200)

    def plain(d: torch.Tensor) -> torch.Tensor:
        texels = background.texels.detach().double()
        raw = cube_map.lookup_in_torch(*cube_map.project(d), texels, background.padded, background.levels.resolutions)
        return (F.softplus(raw) * 0.5 / math.log(2)).square()

    assert torch.autograd.gradcheck(plain, directions[:10].double().requires_grad_())
    gradients = []
    for sky, d in ((lambda d: background(Exits(d)), directions), (plain, directions.double())):
        d = d.clone().requires_grad_()
        gradients.append(torch.autograd.grad((sky(d) * torch.tensor([1.0, -2.0, 3.0])).sum(), d)[0].double())
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-4)
    # A sky knows no length of directions.
    assert (gradients[1] * directions).sum(-1).abs().max() < 1e-5


def test_lat_long_convention_matches_blender() -> None:
    directions = lat_long.directions(64)
    assert directions.shape == (64, 128, 3)
    middle = directions[32, 64]
    torch.testing.assert_close(middle, torch.tensor([1.0, 0, 0]), rtol=0, atol=0.04)
    torch.testing.assert_close(directions[0, 10], torch.tensor([0.0, 0, 1]), rtol=0, atol=0.04)
    torch.testing.assert_close(directions[32, 32], torch.tensor([0.0, 1, 0]), rtol=0, atol=0.04)  # left of +x


def test_finer_image_is_averaged_and_not_sampled() -> None:
    # One-pixel stripes are far below the texture's resolution: every texel must become their mean.
    stripes = torch.zeros(256, 512, 3)
    stripes[:, ::2] = 0.8
    background = EnvironmentMap([4])
    background.set_lat_long(stripes)
    colours = background(Exits(cube_map.texel_directions(4)))
    torch.testing.assert_close(colours, torch.full_like(colours, 0.4), rtol=0, atol=0.01)


@pytest.mark.parametrize("levels", [([64, 4],), ([4, 64], [32]), ([8], [8])])
def test_levels_that_do_not_ascend_are_refused(levels: tuple[list[int], ...]) -> None:
    refused("do not ascend; give resolutions, and then fitted_resolutions", EnvironmentMap, *levels)


def test_bad_files_are_refused(tmp_path: Path) -> None:
    refused("does not exist", EnvironmentMap, image=str(tmp_path / "none.hdr"))
    refused("allowed are", EnvironmentMap, image=str(tmp_path / "sky.tiff"))
    refused(r"use \.png", lat_long.save_lat_long, tmp_path / "sky.jpg", torch.zeros(8, 16, 3))
    (tmp_path / "broken.hdr").write_bytes(b"#?RADIANCE\n")
    refused("cannot be read", EnvironmentMap, image=str(tmp_path / "broken.hdr"))
    save_png(tmp_path / "square.png", torch.zeros(4, 4, 3))
    refused("twice as wide", EnvironmentMap, image=str(tmp_path / "square.png"))


LEVELS = cube_map.CubeLevels((1, 3, 8))
PADDED = torch.cat([cube_map.padded_texels(n).flatten() for n in LEVELS.resolutions])


def special_directions() -> torch.Tensor:
    """Axes, edges and corners of the cube."""
    grid = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    return torch.nn.functional.normalize(grid[grid.abs().sum(-1) > 0], dim=-1)


def random_texels() -> torch.Tensor:
    return torch.randn(LEVELS.num_texels, 3, generator=torch.Generator().manual_seed(1))


def test_lookup_at_texel_centres_returns_the_texels() -> None:
    texels = torch.randn(216, 3)
    found = cube_map.lookup_in_torch(
        *cube_map.project(cube_map.texel_directions(6)), texels, cube_map.padded_texels(6).flatten(), [6]
    )
    torch.testing.assert_close(found, texels, rtol=0, atol=1e-5)


@pytest.mark.parametrize("lookup", [cube_map.lookup_in_torch, cube_map.lookup])
def test_lookup_is_continuous_across_seams_and_corners(lookup) -> None:
    # Great circles through edges and corners of the cube: values at most 1e-4 rad apart differ by no jump.
    corner = torch.tensor([1.0, 1.0, 1.0]) / math.sqrt(3)
    texels = random_texels()
    for normal in (torch.tensor([1.0, -1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, -0.9, -0.1])):
        first = torch.linalg.cross(normal / normal.norm(), corner)
        first = first / first.norm()
        second = torch.linalg.cross(normal / normal.norm(), first)
        angle = torch.linspace(0, 2 * math.pi, 62833)[:, None]
        directions = torch.nn.functional.normalize(angle.cos() * first + angle.sin() * second, dim=-1)
        found = lookup(*cube_map.project(directions), texels, PADDED, LEVELS.resolutions)
        steepest = 6 * 8 * float(texels.abs().max())  # per radian, generously
        assert (found[1:] - found[:-1]).abs().max() < steepest * 1e-4


@pytest.mark.parametrize("num", [0, 1, 2000])
def test_kernels_match_the_reference_forward_and_backward(num: int) -> None:
    face, coordinates = cube_map.project(torch.cat([random_directions(num), special_directions()]))
    inputs = (coordinates.requires_grad_(), random_texels().requires_grad_())
    found, expected = (
        look(face, *inputs, PADDED, LEVELS.resolutions) for look in (cube_map.lookup, cube_map.lookup_in_torch)
    )
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    require_equal_gradients(found, expected, inputs)
