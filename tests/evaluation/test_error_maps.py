from pathlib import Path

import pytest
import torch

from nerfro.evaluation.image_metrics import build_metrics, psnr, squared_error_map, ssim, triptych
from nerfro.evaluation.perceptual import LpipsNetwork, flip, published_weights
from nerfro.evaluation.scoring import error_maps, write_error_sheet
from nerfro.files.images import load_png, magma, round_to_8bit
from nerfro.registry.registration import discover

discover()


@pytest.mark.usefixtures("unchecked")
def test_means_of_the_maps_are_the_metrics() -> None:
    prediction, target = torch.rand(2, 40, 36, 3, generator=torch.Generator().manual_seed(0))
    maps = {error.name: error for error in error_maps(prediction, target, build_metrics())}
    assert list(maps) == ["squared_error", "ssim", "lpips", "flip"]
    assert all(error.values.shape == (40, 36) for error in maps.values())
    assert -10 * maps["squared_error"].values.mean().log10() == pytest.approx(psnr(prediction, target).item(), abs=1e-5)
    assert 1 - maps["ssim"].values.nanmean().item() == pytest.approx(ssim(prediction, target).item(), abs=1e-9)
    assert torch.equal(maps["lpips"].values, LpipsNetwork(published_weights()).distance_map(prediction, target))
    assert maps["flip"].values.mean().item() == pytest.approx(flip(prediction, target).item(), abs=1e-6)


def test_border_without_ssim_window_is_grey() -> None:
    prediction, target = torch.rand(2, 16, 20, 3, generator=torch.Generator().manual_seed(0))
    error = error_maps(prediction, target, build_metrics())[1]
    assert error.values[5:-5, 5:-5].isfinite().all()
    assert error.values.isnan().sum() == 16 * 20 - 6 * 10
    colours = error.colours()
    assert torch.equal(colours[0, 0], colours[4, 7])
    assert (colours[0, 0] == colours[0, 0, 0]).all()


@pytest.mark.usefixtures("unchecked")
def test_maps_are_omitted_for_small_images() -> None:
    prediction, target = torch.rand(2, 10, 30, 3, generator=torch.Generator().manual_seed(0))
    maps = error_maps(prediction, target, build_metrics())
    assert [error.name for error in maps] == ["squared_error", "flip"]


def test_sheet_contains_images_and_maps(tmp_path: Path) -> None:
    prediction, target = torch.rand(2, 64, 128, 3, generator=torch.Generator().manual_seed(0))
    write_error_sheet(tmp_path, "a", prediction, target, build_metrics())
    sheet = load_png(tmp_path / "errors" / "a.png")
    for column, shown in enumerate((prediction, target, magma(squared_error_map(prediction, target), 0.05))):
        enlarged = round_to_8bit(shown).repeat_interleave(2, 0).repeat_interleave(2, 1)
        left = column * (256 + 6)
        torch.testing.assert_close(sheet[22 : 22 + 128, left : left + 256], enlarged)
        assert sheet[22 + 128 :, left : left + 256].min() < 0.2, "a caption in ink"


def test_triptych_contains_prediction_reference_and_error() -> None:
    prediction, target = torch.rand(2, 8, 9, 3, generator=torch.Generator().manual_seed(0))
    parts = triptych(prediction, target).split(9, dim=1)
    error = magma(squared_error_map(prediction, target), 0.05)
    for part, expected in zip(parts, (prediction, target, error), strict=True):
        torch.testing.assert_close(part, expected)
