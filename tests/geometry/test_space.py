"""Contracted space: positions and lengths against closed forms and numerical integrals."""

import math

import pytest
import torch

from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.space import FAR, Box, Contracted, Unbounded, contracted_length, world_length
from tests.conftest import refused

CENTRE = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
RADIUS = 1.5
SPACE = Contracted(torch.stack([CENTRE - 0.1, CENTRE + 0.1]), RADIUS).double()
IMPACT_PARAMETERS = torch.tensor([0.0, 1e-4, 0.7, 1.4999, 1.5, 2.0, 30.0], dtype=torch.float64)


def test_contraction_keeps_the_ball_and_maps_infinity_to_twice_its_radius() -> None:
    offsets = torch.tensor([[0.3, -0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -4.0], [3e6, 4e6, 0.0]])
    expected = torch.tensor([[0.3, -0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.75], [1.2, 1.6, 0.0]]).double()
    torch.testing.assert_close(SPACE.contract(CENTRE + RADIUS * offsets), CENTRE + RADIUS * expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(SPACE.box, torch.stack([CENTRE - 3, CENTRE + 3]))
    assert SPACE.exists(CENTRE + 1.999 * RADIUS * torch.eye(3)).all()
    assert not SPACE.exists(CENTRE + 2.001 * RADIUS * torch.eye(3)).any()


def test_expansion_inverts_contraction() -> None:
    x = CENTRE + torch.randn(200, 3, dtype=torch.float64) * torch.logspace(-1, 3, 200, dtype=torch.float64)[:, None]
    torch.testing.assert_close(SPACE.expand(SPACE.contract(x)), x)


def test_contraction_scale_is_the_derivative_along_radial_lines() -> None:
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    distance = torch.linspace(0.1, 20, 50, dtype=torch.float64)
    ends = [SPACE.contract(CENTRE + (distance + h)[:, None] * directions) for h in (-1e-5, 1e-5)]
    found = (ends[1] - ends[0]).norm(dim=-1) / 2e-5
    torch.testing.assert_close(SPACE.scale(CENTRE + distance[:, None] * directions), found, rtol=1e-5, atol=0)


@pytest.mark.parametrize("impact_parameter", IMPACT_PARAMETERS.tolist())
def test_contracted_length_is_the_integral_of_the_contraction_scale(impact_parameter: float) -> None:
    t = torch.linspace(-40, 60, 400_001, dtype=torch.float64)
    middles = 0.5 * (t[1:] + t[:-1])
    places = torch.stack([middles, torch.full_like(middles, impact_parameter), torch.zeros_like(middles)], -1)
    added_up = (SPACE.scale(CENTRE + places) * t.diff()).sum()
    of_a_line = torch.tensor(impact_parameter, dtype=torch.float64)
    first, last = contracted_length(t[[0, -1]], of_a_line, RADIUS)
    torch.testing.assert_close(last - first, added_up, rtol=1e-6, atol=1e-6)


def test_contracted_length_to_infinity_matches_closed_form() -> None:
    through = contracted_length(
        torch.tensor([math.inf], dtype=torch.float64).clamp(max=1e12), IMPACT_PARAMETERS[:1], RADIUS
    )
    torch.testing.assert_close(through, torch.tensor([2 * RADIUS], dtype=torch.float64))
    past = contracted_length(torch.tensor([1e12], dtype=torch.float64), IMPACT_PARAMETERS[-1:], RADIUS)
    torch.testing.assert_close(past, math.pi / 2 * RADIUS**2 / IMPACT_PARAMETERS[-1:])


def test_world_length_inverts_contracted_length() -> None:
    t = torch.cat([-torch.logspace(-3, math.log10(FAR), 60), torch.logspace(-3, math.log10(FAR), 60)]).double()
    for impact_parameter in IMPACT_PARAMETERS:
        length = contracted_length(t, impact_parameter, RADIUS)
        torch.testing.assert_close(world_length(length, impact_parameter, RADIUS), t, rtol=1e-6, atol=1e-9)


def test_contracted_positions_have_gradients() -> None:
    x = (CENTRE + torch.tensor([[0.3, 0.2, -0.4], [3.0, -1.0, 2.0], [0.0, 0.0, -90.0]])).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: (SPACE.contract(x), SPACE.scale(x)), x)


def test_a_box_has_world_coordinates() -> None:
    space, x = (
        Box([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        torch.tensor([[0.5, 1.0, 2.9], [0.5, 2.1, 1.0], [torch.nan] * 3]),
    )
    torch.testing.assert_close(space.expand(space.contract(x)), x, equal_nan=True)
    assert space.scale(x) == 1
    assert space.inside(x).tolist() == [True, False, False]
    assert space.side == 3


def test_only_a_space_with_a_box_can_have_grids() -> None:
    refused("give a Box or a Contracted space", HashGridField, Unbounded())
