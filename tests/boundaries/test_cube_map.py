"""The equi-angular cube map, and its compiled lookup against the reference."""

from __future__ import annotations

import math

import pytest
import torch

from nerfro.boundaries import cube_map
from nerfro.boundaries import cube_map_cpu as kernels

LEVELS = cube_map.CubeLevels((1, 3, 8))
PADDED = torch.cat([cube_map.padded_texels(n).flatten() for n in LEVELS.resolutions])


def random_directions(num: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)


def special_directions() -> torch.Tensor:
    """Axes, edges and corners of the cube."""
    grid = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    return torch.nn.functional.normalize(grid[grid.abs().sum(-1) > 0], dim=-1)


def random_texels() -> torch.Tensor:
    return torch.randn(LEVELS.num_texels, 3, generator=torch.Generator().manual_seed(1))


def test_projection_is_inverted() -> None:
    directions = torch.cat([random_directions(500), special_directions()])
    face, coordinates = cube_map.project(directions)
    assert coordinates.abs().max() <= 1 + 1e-6
    torch.testing.assert_close(cube_map.unproject(face, coordinates), directions, rtol=0, atol=1e-6)


def test_steps_in_texture_are_steps_in_angle() -> None:
    angles = torch.linspace(-math.pi / 4 + 1e-4, math.pi / 4 - 1e-4, 9)
    directions = torch.stack([angles.cos(), angles.sin(), torch.zeros(9)], -1)
    face, coordinates = cube_map.project(directions)
    assert not face.any()  # +x
    torch.testing.assert_close(coordinates[:, 0], angles * 4 / math.pi)
    torch.testing.assert_close(coordinates[:, 1], torch.zeros(9))


def test_texel_centres_look_themselves_up() -> None:
    levels = cube_map.CubeLevels((6,))
    texels = torch.randn(levels.num_texels, 3)
    found = cube_map.lookup(
        *cube_map.project(cube_map.texel_directions(6)), texels, cube_map.padded_texels(6).flatten(), levels
    )
    torch.testing.assert_close(found, texels, rtol=0, atol=1e-5)


@pytest.mark.parametrize("lookup", [cube_map.lookup, kernels.lookup])
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
        found = lookup(*cube_map.project(directions), texels, PADDED, LEVELS)
        steepest = 6 * 8 * float(texels.abs().max())  # per radian, generously
        assert (found[1:] - found[:-1]).abs().max() < steepest * 1e-4


def test_weights_sum_to_one_everywhere() -> None:
    directions = torch.cat([random_directions(2000), special_directions()])
    found = cube_map.lookup(*cube_map.project(directions), torch.ones(LEVELS.num_texels, 3), PADDED, LEVELS)
    torch.testing.assert_close(found, torch.full_like(found, len(LEVELS)))


@pytest.mark.parametrize("num", [0, 1, 2000])
def test_kernels_match_the_reference_forward_and_backward(num: int) -> None:
    face, coordinates = cube_map.project(torch.cat([random_directions(num), special_directions()]))
    inputs = (coordinates.requires_grad_(), random_texels().requires_grad_())
    found, expected = (look(face, *inputs, PADDED, LEVELS) for look in (kernels.lookup, cube_map.lookup))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    upstream = torch.randn(expected.shape, generator=torch.Generator().manual_seed(2))
    gradients = (torch.autograd.grad(output, inputs, upstream) for output in (found, expected))
    for ours, reference in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, reference, rtol=1e-5, atol=1e-5 * float(reference.abs().max()))


def test_gradients_are_those_of_differences() -> None:
    # Beside the cube's corners too, where three faces meet and one of four texels is missing.
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) + 0.1 * random_directions(8, seed=3)
    directions = torch.cat([random_directions(12), corners]).double().requires_grad_()
    texels = random_texels().double()

    def sky(d: torch.Tensor) -> torch.Tensor:
        return cube_map.lookup(*cube_map.project(d), texels, PADDED, LEVELS)

    assert torch.autograd.gradcheck(sky, directions)
