"""The transfer function against the standard's values and itself."""

from __future__ import annotations

import torch

from nerfro.light import to_linear, to_srgb


def test_middle_grey_and_the_ends_are_the_standards() -> None:
    torch.testing.assert_close(to_linear(torch.tensor([0.0, 0.5, 1.0])), torch.tensor([0.0, 0.214041, 1.0]))


def test_encoding_undoes_decoding_with_finite_gradients() -> None:
    srgb = torch.linspace(0, 1, 256, requires_grad=True)
    linear = to_linear(srgb)
    torch.testing.assert_close(to_srgb(linear), srgb, rtol=0, atol=1e-6)
    to_srgb(linear).sum().backward()
    assert srgb.grad is not None
    assert srgb.grad.isfinite().all()
