import pytest
import torch

from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import magma, squared_error_map
from nerfro.evaluation.metrics import psnr


def test_mean_of_the_error_map_is_what_psnr_measures() -> None:
    prediction, target = torch.rand(2, 12, 9, 3, generator=torch.Generator().manual_seed(0))
    errors = squared_error_map(prediction, target)
    assert errors.shape == (12, 9)
    assert -10 * torch.log10(errors.mean()).item() == pytest.approx(psnr(prediction, target).item(), abs=1e-5)


def test_colours_grow_brighter_with_the_value() -> None:
    ramp = magma(torch.linspace(0, 2, 256)[None], limit=2.0)[0]
    linear = torch.where(ramp <= 0.04045, ramp / 12.92, ((ramp + 0.055) / 1.055) ** 2.4)
    luminance = linear @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()
    assert luminance[0] < 0.01
    assert luminance[-1] > 0.9


def test_scale_is_fixed_and_not_fitted_to_the_values() -> None:
    small, large = torch.tensor([[0.0, 0.01]]), torch.tensor([[0.0, 0.01, 7.0]])
    assert torch.equal(magma(small, 0.05)[0], magma(large, 0.05)[0, :2])
    assert torch.equal(magma(large, 0.05)[0, 2], magma(torch.tensor([[0.05]]), 0.05)[0, 0])


def test_impossible_maps_are_refused() -> None:
    with pytest.raises(NerfroError, match="positive, got 0"):
        magma(torch.zeros(2, 2), 0)
    with pytest.raises(NerfroError, match="of one size"):
        squared_error_map(torch.zeros(2, 2, 3), torch.zeros(2, 1, 3))
