import flip_evaluator
import pytest
import torch
from torch import Tensor

from nerfro.evaluation.flip import flip, flip_map


def pictures(seed: int) -> tuple[Tensor, Tensor]:
    prediction, target = torch.rand(2, 24, 40, 3, generator=torch.Generator().manual_seed(seed))
    return prediction, target


@pytest.mark.parametrize("swap", [False, True])
def test_map_and_mean_are_those_of_flip_evaluator_whose_first_argument_is_the_reference(swap: bool) -> None:
    prediction, target = pictures(0)[::-1] if swap else pictures(0)
    errors, mean, viewed = flip_evaluator.evaluate(target.numpy(), prediction.numpy(), "LDR", applyMagma=False)
    assert viewed["ppd"] == pytest.approx(67.02, abs=0.01)
    torch.testing.assert_close(flip_map(prediction, target), torch.from_numpy(errors[..., 0]))
    assert flip(prediction, target).item() == pytest.approx(mean, abs=1e-6)
    inside = torch.zeros(24, 40, dtype=torch.bool)
    inside[3:9, 10:20] = True
    assert flip(prediction, target, inside).item() == pytest.approx(errors[3:9, 10:20].mean(), abs=1e-6)
