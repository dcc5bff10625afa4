import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from nerfro.errors import NerfroError
from nerfro.evaluation.ssim import ssim, ssim_map
from tests.evaluation.test_metrics import pictures


@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_that_of_torchmetrics_over_whole_windows(seed: int) -> None:
    prediction, target = pictures(seed=seed)
    batches = [image.double().permute(2, 0, 1)[None] for image in (prediction, target)]
    _, full = structural_similarity_index_measure(*batches, data_range=1.0, return_full_image=True)
    whole = full[0, :, 5:-5, 5:-5]
    torch.testing.assert_close(ssim_map(prediction, target), whole.permute(1, 2, 0), atol=1e-6, rtol=0)
    assert ssim(prediction, target).item() == pytest.approx(whole.mean().item(), abs=1e-6)


def test_ssim_on_a_mask_is_the_mean_of_the_map_there() -> None:
    prediction, target = pictures()
    inside = torch.zeros(37, 45, dtype=torch.bool)
    inside[0:20, 3:30] = True  # reaches over the border, where there is no whole window
    expected = ssim_map(prediction, target)[:15, :25].mean()
    assert ssim(prediction, target, inside).item() == pytest.approx(expected.item())
    border = torch.zeros(37, 45, dtype=torch.bool)
    border[:5] = True
    assert ssim(prediction, target, border).isnan()


def test_a_picture_without_a_whole_window_is_refused() -> None:
    with pytest.raises(NerfroError, match="at least 11 x 11"):
        ssim(torch.zeros(10, 40, 3), torch.zeros(10, 40, 3))
