"""Gradients of two implementations of one function."""

from collections.abc import Sequence

import torch
from torch import Tensor


def require_equal_gradients(
    found: Tensor, expected: Tensor, inputs: Sequence[Tensor], tolerance: float = 1e-5, atol: float | None = None
) -> None:
    """Require that results have equal gradients by their inputs; by default up to 1e-5 of the largest gradient."""
    upstream = torch.randn(expected.shape, generator=torch.Generator().manual_seed(3)).to(expected.dtype)
    gradients = (torch.autograd.grad(result, inputs, upstream) for result in (found, expected))
    for ours, reference in zip(*gradients, strict=True):
        assert ours.dtype == reference.dtype
        largest = float(reference.abs().max()) if reference.numel() else 0.0
        torch.testing.assert_close(ours, reference, rtol=tolerance, atol=1e-5 * largest if atol is None else atol)
