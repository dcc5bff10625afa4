import flip_evaluator
import pytest
import torch
from torch import Tensor

from nerfro.evaluation.flip import flip, flip_map
from nerfro.evaluation.metrics import MeanOverImages


def pictures(seed: int) -> tuple[Tensor, Tensor]:
    prediction, target = torch.rand(2, 24, 40, 3, generator=torch.Generator().manual_seed(seed))
    return prediction, target


def test_map_and_mean_are_those_of_flip_evaluator() -> None:
    prediction, target = pictures(0)
    errors, mean, viewed = flip_evaluator.evaluate(target.numpy(), prediction.numpy(), "LDR", applyMagma=False)
    assert viewed["ppd"] == pytest.approx(67.02, abs=0.01)
    torch.testing.assert_close(flip_map(prediction, target), torch.from_numpy(errors[..., 0]))
    assert flip(prediction, target).item() == pytest.approx(mean, abs=1e-6)


def test_the_reference_is_told_from_the_prediction() -> None:
    prediction, target = pictures(0)
    swapped = flip_evaluator.evaluate(prediction.numpy(), target.numpy(), "LDR", applyMagma=False)[1]
    ours = flip(prediction, target).item()
    assert ours == pytest.approx(flip_evaluator.evaluate(target.numpy(), prediction.numpy(), "LDR")[1], abs=1e-6)
    assert flip(target, prediction).item() == pytest.approx(swapped, abs=1e-6)


def test_black_on_white_is_the_largest_difference_and_equal_pictures_have_none() -> None:
    black, white = torch.zeros(16, 16, 3), torch.ones(16, 16, 3)
    assert flip(black, black).item() == 0
    assert flip(black, white).item() > 0.9


def test_pictures_need_not_be_contiguous_or_of_single_precision() -> None:
    prediction, target = pictures(0)
    turned = flip(prediction.double().transpose(0, 1), target.double().transpose(0, 1))
    straight = flip(prediction.transpose(0, 1).contiguous(), target.transpose(0, 1).contiguous())
    assert turned.item() == pytest.approx(straight.item(), abs=1e-7)


def test_metric_is_the_mean_over_pictures_or_over_their_pixels_in_masks() -> None:
    inside = torch.zeros(24, 40, dtype=torch.bool)
    inside[3:9, 10:20] = True
    metric, masked = MeanOverImages(flip), MeanOverImages(flip)
    for seed in range(3):
        metric.update(*pictures(seed))
        masked.update(*pictures(seed), inside)
    maps = torch.stack([flip_map(*pictures(seed)) for seed in range(3)])
    assert metric.compute().item() == pytest.approx(maps.mean().item(), abs=1e-6)
    assert masked.compute().item() == pytest.approx(maps[:, 3:9, 10:20].mean().item(), abs=1e-6)
