"""Positional encodings: their order, and the integrated one against Monte Carlo."""

import math

import torch

from tests.paper import integrated_positional_encoding, positional_encoding


def test_order_is_identity_then_all_sines_then_all_cosines_octave_by_octave() -> None:
    x = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    expected = x.tolist()
    for wave in (math.sin, math.cos):
        for octave in range(4):
            expected += [wave(2**octave * float(v)) for v in x]
    encoded = positional_encoding(x, 4)
    torch.testing.assert_close(encoded, torch.tensor(expected, dtype=torch.float64))


def test_integrated_encoding_is_the_mean_encoding_over_the_gaussian() -> None:
    num_draws = 200_000
    mean = torch.tensor([0.4, -0.2, 0.9], dtype=torch.float64)
    variance = torch.tensor([0.01, 0.2, 0.0], dtype=torch.float64)
    draws = mean + variance.sqrt() * torch.randn(num_draws, 3, dtype=torch.float64)
    monte_carlo = positional_encoding(draws, 6)[:, 3:].mean(0)
    integrated = integrated_positional_encoding(mean, variance, 6)
    # Each entry's standard deviation is at most 1; five standard errors.
    assert (integrated - monte_carlo).abs().max() < 5 / math.sqrt(num_draws)


def test_integrated_encoding_of_a_point_is_the_plain_one() -> None:
    x = torch.rand(7, 3, dtype=torch.float64)
    integrated = integrated_positional_encoding(x, torch.zeros_like(x), 8)
    torch.testing.assert_close(integrated, positional_encoding(x, 8)[:, 3:])
