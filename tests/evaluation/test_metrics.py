import math
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.images import load_png, save_png
from nerfro.evaluation.metrics import MAX_PSNR, ImageMetrics, psnr, ssim, ssim_map


def pictures(seed: int = 0, height: int = 37, width: int = 45) -> tuple[Tensor, Tensor]:
    """A smooth picture with an edge, and the same with noise, a shift and a flat part."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    target = torch.stack([0.5 + 0.4 * torch.sin(9 * x), y, (x > y).float()], dim=-1)
    prediction = target.roll(1, dims=1) + 0.1 * torch.randn(target.shape, generator=generator)
    prediction[:15] = 0.5
    return prediction.clamp(0, 1), target


def reference_ssim(prediction: Tensor, target: Tensor) -> tuple[float, np.ndarray]:
    return structural_similarity(
        prediction.double().numpy(),
        target.double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )


@pytest.mark.parametrize("seed", range(3))
def test_psnr_is_that_of_scikit_image(seed: int) -> None:
    prediction, target = pictures(seed)
    expected = peak_signal_noise_ratio(target.double().numpy(), prediction.double().numpy(), data_range=1.0)
    assert psnr(prediction, target).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_that_of_scikit_image_over_whole_windows(seed: int) -> None:
    prediction, target = pictures(seed)
    mean, full = reference_ssim(prediction, target)
    assert ssim(prediction, target).item() == pytest.approx(mean, abs=1e-6)
    assert np.abs(ssim_map(prediction, target).numpy() - full[5:-5, 5:-5]).max() < 1e-6


def test_uniform_error_has_the_psnr_of_its_square() -> None:
    target = torch.full((8, 8, 3), 0.3)
    assert psnr(target + 0.1, target).item() == pytest.approx(20.0, abs=1e-5)


def test_flat_pictures_have_the_ssim_of_their_luminance() -> None:
    a, b, stabiliser = 0.2, 0.7, 0.01**2
    expected = (2 * a * b + stabiliser) / (a * a + b * b + stabiliser)
    actual = ssim(torch.full((16, 16, 3), a, dtype=torch.float64), torch.full((16, 16, 3), b, dtype=torch.float64))
    assert actual.item() == pytest.approx(expected, abs=1e-9)


def test_equal_pictures_score_best_and_finite() -> None:
    _, target = pictures()
    metrics = ImageMetrics(None, round_predictions=False)
    metrics.update(target, target)
    assert metrics.result().mean("psnr") == MAX_PSNR
    assert metrics.result().mean("ssim") == pytest.approx(1.0)


def test_mean_psnr_is_the_mean_over_views_and_not_over_pixels() -> None:
    target = torch.full((16, 16, 3), 0.4)
    metrics = ImageMetrics(None, round_predictions=False)
    metrics.update(target + 0.1, target)
    metrics.update(target + 0.001, target)
    assert metrics.result().mean("psnr") == pytest.approx((20 + 60) / 2, abs=1e-3)


def test_numbers_can_be_computed_again_from_the_written_pictures(tmp_path: Path) -> None:
    metrics, again = ImageMetrics(None), ImageMetrics(None, round_predictions=False)
    for view in range(3):
        prediction, target = pictures(view)
        prediction = prediction * 1.2 - 0.1  # parts that cannot be displayed are clipped
        save_png(tmp_path / f"test_{view:03d}.png", prediction)
        metrics.update(prediction, target)
        again.update(load_png(tmp_path / f"test_{view:03d}.png"), target)
    assert [row.scores for row in metrics.result().views] == [row.scores for row in again.result().views]


def test_float_protocol_clips_but_does_not_round() -> None:
    target = torch.zeros(16, 16, 3)
    metrics = ImageMetrics(None, round_predictions=False)
    metrics.update(target + 0.001, target)  # a quarter of a level
    metrics.update(target - 0.5, target)
    first, second = (row.scores["psnr"] for row in metrics.result().views)
    assert first == pytest.approx(60, abs=1e-3)
    assert second == MAX_PSNR
    assert metrics.result().protocol == "float"


def test_lpips_of_a_view_is_that_of_the_network() -> None:
    class Halves(torch.nn.Module):
        def forward(self, prediction: Tensor, target: Tensor) -> Tensor:
            return (prediction - target).abs().mean() / 2

    target = torch.zeros(32, 32, 3)
    metrics = ImageMetrics(Halves(), round_predictions=False)
    metrics.update(target + 0.5, target)
    assert metrics.result().mean("lpips") == pytest.approx(0.25)
    assert metrics.result().notes == {}


def test_missing_metrics_are_none_with_a_reason() -> None:
    metrics = ImageMetrics(None, "no network")
    metrics.update(*pictures())
    metrics.update(*pictures(height=10))
    result = metrics.result()
    assert result.mean("psnr") is not None
    assert [row.scores["ssim"] is None for row in result.views] == [False, True]
    assert result.mean("ssim") is None
    assert result.notes == {"ssim": "pictures smaller than its window of 11 pixels", "lpips": "no network"}


def test_views_are_ordered_by_number_and_repeated_ones_count_once() -> None:
    metrics = ImageMetrics(None, prefix="val")
    for view in (2, 0, 2):
        metrics.update(*pictures(view), view=view)
    result = metrics.result()
    assert [row.name for row in result.views] == ["val_000", "val_002"]
    assert result.views[1].scores["psnr"] != result.views[0].scores["psnr"]


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_reset_forgets_all_views() -> None:
    metrics = ImageMetrics(None)
    metrics.update(*pictures())
    metrics.reset()
    with pytest.raises(NerfroError, match="no view was scored"):
        metrics.result()


def test_pictures_that_cannot_be_compared_are_refused() -> None:
    metrics = ImageMetrics(None)
    with pytest.raises(NerfroError, match=r"\[16, 16, 3\] with a reference \[16, 17, 3\]"):
        metrics.update(torch.zeros(16, 16, 3), torch.zeros(16, 17, 3))
    with pytest.raises(NerfroError, match="NaN"):
        metrics.update(torch.full((16, 16, 3), math.nan), torch.zeros(16, 16, 3))
    with pytest.raises(NerfroError, match="at least 11 x 11"):
        ssim(torch.zeros(10, 40, 3), torch.zeros(10, 40, 3))


def test_views_scored_by_another_process_are_gathered() -> None:
    alone, here, there = (ImageMetrics(None) for _ in range(3))
    for view in range(3):
        alone.update(*pictures(view), view=view)
        (here if view == 1 else there).update(*pictures(view), view=view)
    # torchmetrics' own way to stand in for a process group: what gathers, and that there is one.
    here.dist_sync_fn = lambda rows, group: [rows, torch.cat(there.rows)]
    here.distributed_available_fn = lambda: True
    assert here.result() == alone.result()
