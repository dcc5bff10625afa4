"""Spherical harmonics as an encoding."""

import math

import pytest
import torch

from nerfro.fields.spherical_harmonics import spherical_harmonics, spherical_harmonics_in_torch
from tests.gradients import require_equal_gradients


def quadrature() -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights that integrate polynomials to degree 7 over the sphere exactly."""
    # Four Gauss-Legendre nodes in z, eight equidistant azimuths.
    nodes = [0.3399810435848563, 0.8611363115940526]
    masses = [0.6521451548625461, 0.3478548451374538]
    z = torch.tensor([-nodes[1], -nodes[0], nodes[0], nodes[1]], dtype=torch.float64)
    mass = torch.tensor([masses[1], masses[0], masses[0], masses[1]], dtype=torch.float64)
    angle = torch.arange(8, dtype=torch.float64) * math.pi / 4 + 0.1
    radius = torch.sqrt(1 - z**2)
    directions = torch.stack(
        [radius[:, None] * angle.cos(), radius[:, None] * angle.sin(), z[:, None].expand(4, 8)], dim=-1
    )
    return directions.reshape(-1, 3), (mass[:, None] * 2 * math.pi / 8).expand(4, 8).reshape(-1)


def test_harmonics_are_orthonormal() -> None:
    directions, weights = quadrature()
    harmonics = spherical_harmonics_in_torch(directions, 4)
    gram = harmonics.T @ (weights[:, None] * harmonics)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


def test_each_degree_is_closed_under_rotation() -> None:
    # Addition theorem: the sum of squares over a degree is (2 l + 1) / (4 pi) in every direction.
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    harmonics = spherical_harmonics_in_torch(directions, 4)
    for degree in range(4):
        power = harmonics[:, degree**2 : (degree + 1) ** 2].square().sum(-1)
        torch.testing.assert_close(power, torch.full_like(power, (2 * degree + 1) / (4 * math.pi)))


@pytest.mark.parametrize("num_bands", [1, 2, 3, 4])
def test_kernel_equals_the_reference_forward_and_backward(num_bands: int) -> None:
    directions = torch.nn.functional.normalize(torch.randn(70, 3), dim=-1).requires_grad_()
    # The first band is constant, which plain PyTorch takes for independent of the directions.
    expected = spherical_harmonics_in_torch(directions, num_bands) + 0 * directions[:, :1]
    found = spherical_harmonics(directions, num_bands)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    require_equal_gradients(found, expected, [directions], atol=1e-5)
