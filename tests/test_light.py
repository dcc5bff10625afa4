"""The transfer function against the standard's values and itself."""

import numpy as np
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


def test_arrays_are_coded_as_tensors_are() -> None:
    values = np.linspace(0, 1.5, 24, dtype=np.float32).reshape(4, 6)[::-1]  # negative strides, as in flipped pictures
    for code in (to_linear, to_srgb):
        np.testing.assert_array_equal(code(values), code(torch.tensor(values.copy())).numpy())
        assert code(values).dtype == np.float32
    assert to_srgb(np.array(0.18)).shape == ()
