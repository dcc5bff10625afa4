"""Metrics of images against other packages, error maps, scores of views and regions, and the announced time."""

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import flip_evaluator
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation
from skimage.metrics import peak_signal_noise_ratio
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

import nerfro
from nerfro.evaluation import scoring
from nerfro.evaluation.image_metrics import (
    build_metrics,
    crop_rectangle,
    image_metrics,
    object_pixels,
    psnr,
    squared_error_map,
    ssim,
    ssim_map,
    triptych,
)
from nerfro.evaluation.perceptual import Lpips, LpipsNetwork, flip, flip_map, published_weights
from nerfro.evaluation.results import (
    EvaluationResult,
    RunMetrics,
    ViewScores,
    read_metrics_json,
    write_metrics_json,
)
from nerfro.evaluation.scoring import ImageMetrics, error_maps, write_error_sheet
from nerfro.files.images import load_png, magma, round_to_8bit, save_png
from nerfro.models.refractive import RefractiveModel
from nerfro.registry.registration import discover
from nerfro.samplers.subdivision import Subdivision
from nerfro.testing.examples import example_components, example_views
from tests.conftest import refused

discover()


def pictures(seed: int = 0, height: int = 37, width: int = 45) -> tuple[Tensor, Tensor]:
    """A smooth picture of 8 bits with an edge, and the same with noise, a shift and a flat part."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    target = torch.stack([0.5 + 0.4 * torch.sin(9 * x), y, (x > y).float()], dim=-1)
    prediction = target.roll(1, dims=1) + 0.1 * torch.randn(target.shape, generator=generator)
    prediction[:15] = 0.5
    return round_to_8bit(prediction), round_to_8bit(target)


def scored(*compared: tuple[Tensor, ...], metrics: ImageMetrics | None = None) -> EvaluationResult:
    """Score pairs of pictures, each with the coverage by the object if there is one."""
    metrics = metrics or ImageMetrics()
    return metrics.result([metrics.score(f"v{number}", *images) for number, images in enumerate(compared)])


def test_psnr_matches_scikit_image() -> None:
    prediction, target = pictures()
    expected = peak_signal_noise_ratio(target.double().numpy(), prediction.double().numpy(), data_range=1.0)
    assert psnr(prediction, target).item() == pytest.approx(expected, abs=1e-6)


def test_mean_psnr_is_the_mean_over_views_and_not_over_pixels() -> None:
    target = torch.full((16, 16, 3), 0.4)
    result = scored((target + 0.2, target), (target + 1 / 255, target))
    assert result.mean("psnr") == pytest.approx(-10 * math.log10(0.2 / 255), abs=1e-3)


def test_scores_are_reproducible_from_the_written_images(tmp_path: Path) -> None:
    prediction, target = pictures()
    prediction = prediction * 1.2 - 0.1  # parts that cannot be displayed are clipped
    save_png(tmp_path / "a.png", prediction)
    written = load_png(tmp_path / "a.png")
    result = scored((prediction, target))
    assert result.mean("psnr") == pytest.approx(psnr(written, target).item())
    assert result.mean("ssim") == pytest.approx(ssim(written, target).item())


@pytest.mark.usefixtures("unchecked")
def test_every_region_has_the_scores_of_its_pixels() -> None:
    prediction, target = pictures(height=190, width=200)
    coverage = torch.zeros(190, 200)
    coverage[60:100, 80:95] = 0.7
    coverage[100:103, 80:95] = 0.3
    inside = coverage > 0.5
    result = scored((prediction, target, coverage))
    crop = slice(60 - 17, 100 + 17), slice(80 - 17, 95 + 17)
    regions = {
        "full": (prediction, target, None),
        "mask": (prediction, target, inside),
        "crop": (prediction[crop], target[crop], None),
    }
    assert result.regions == tuple(regions)
    metric = {"psnr": psnr, "ssim": ssim, "lpips": Lpips(), "flip": flip}
    for region, compared in regions.items():
        for name, function in metric.items():
            assert result.mean(name, region) == pytest.approx(function(*compared).item(), abs=1e-6), (name, region)
    assert len({result.mean("psnr", region) for region in regions}) == 3


def test_views_without_the_object_have_only_full_image_scores() -> None:
    images = pictures()
    full = torch.ones(images[0].shape[:2])
    result = scored((*images, full), (*images, 0 * full), images)
    assert [view.score("psnr", "mask") is None for view in result.views] == [False, True, True]
    assert [view.score("psnr") is None for view in result.views] == [False, False, False]
    assert result.mean("psnr", "mask") is None
    assert result.notes["mask"] == "the mask is missing or covers half of no pixel in v1, v2"
    assert scored((*images, 0 * full)).notes["mask"] == "the mask is missing or covers half of no pixel in v0"


def test_missing_metrics_are_none_with_a_reason() -> None:
    result = scored(pictures(), pictures(height=10), metrics=ImageMetrics())
    assert result.mean("psnr") is not None
    assert result.mean("flip") is not None
    assert [row.scores["ssim"] is None for row in result.views] == [False, True]
    assert result.mean("ssim") is None
    assert result.notes == {
        "ssim": "images, masks or crops below 11 pixels",
        "lpips": "images, masks or crops below 31 pixels",
    }


def test_evaluation_without_views_is_refused() -> None:
    refused("no view was scored", scored)


@pytest.mark.usefixtures("unchecked")
def test_incomparable_images_are_refused() -> None:
    black = torch.zeros(16, 16, 3)
    refused(r"\[16, 16, 3\] with a reference \[16, 17, 3\]", scored, (black, torch.zeros(16, 17, 3)))
    refused("NaN", scored, (math.nan * black, black))
    refused(r"mask \[16, 17\] does not fit an image \[16, 16, 3\]", scored, (black, black, torch.ones(16, 17)))


def test_collection_scores_batches_like_single_images_and_names_its_results() -> None:
    collection = nerfro.metrics("psnr", "flip")
    pairs = [pictures(seed) for seed in range(3)]
    for batch in (pairs[:2], pairs[2:]):
        collection.update(*(torch.stack(images).permute(0, 3, 1, 2) for images in zip(*batch, strict=True)))
    expected = {"psnr": np.mean([psnr(*pair) for pair in pairs]), "flip": np.mean([flip(*pair) for pair in pairs])}
    assert {name: float(score) for name, score in collection.compute().items()} == pytest.approx(expected)
    assert {name: metric.higher_is_better for name, metric in collection.items()} == {"psnr": True, "flip": False}
    refused(r"both must have the same shape \[B, 3, H, W\]", collection.update, *pairs[0])


def test_ssim_matches_torchmetrics_over_whole_windows() -> None:
    prediction, target = pictures()
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


def test_image_without_a_whole_window_is_refused() -> None:
    refused("at least 11 x 11", ssim, torch.zeros(10, 40, 3), torch.zeros(10, 40, 3))


@pytest.mark.parametrize("swap", [False, True])
def test_flip_map_and_mean_match_flip_evaluator(swap: bool) -> None:
    prediction, target = pictures()[::-1] if swap else pictures()
    errors, mean, viewed = flip_evaluator.evaluate(target.numpy(), prediction.numpy(), "LDR", applyMagma=False)
    assert viewed["ppd"] == pytest.approx(67.02, abs=0.01)
    torch.testing.assert_close(flip_map(prediction, target), torch.from_numpy(errors[..., 0]))
    assert flip(prediction, target).item() == pytest.approx(mean, abs=1e-6)
    inside = torch.zeros(37, 45, dtype=torch.bool)
    inside[3:9, 10:20] = True
    assert flip(prediction, target, inside).item() == pytest.approx(errors[3:9, 10:20].mean(), abs=1e-6)


def test_half_covered_pixels_belong_to_the_object() -> None:
    coverage = torch.tensor([[0.0, 0.49, 0.5, 1.0]])
    assert object_pixels(coverage).tolist() == [[False, False, True, True]]


@pytest.mark.parametrize("seed", range(5))
def test_crop_is_the_bounding_rectangle_of_the_mask_dilated_by_seventeen_pixels_to_each_side(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    inside = torch.rand(60, 90, generator=generator) > 0.999
    inside[30, 40] = True
    dilated = torch.from_numpy(binary_dilation(inside.numpy(), torch.ones(35, 35).numpy()))
    rows, columns = dilated.any(1).nonzero(), dilated.any(0).nonzero()
    expected = slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)
    assert crop_rectangle(inside) == expected
    assert torch.equal(dilated[expected].sum(), dilated.sum())


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


@pytest.mark.parametrize(("seconds", "line"), [(1.0, "about 1 min 20 s"), (0.05, "")])
def test_time_of_scoring_is_announced(
    seconds: float, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each of 20 views has four times the pixels of the small rendering, which takes `seconds`."""
    ticks = itertools.count()
    monkeypatch.setattr(scoring.time, "perf_counter", lambda: seconds * next(ticks))
    one = example_views().select([0])
    cameras = type(one.cameras).joined([one.cameras.resized(16, 16)] * 20)
    views = replace(one, cameras=cameras, images=torch.zeros(20, 16, 16, 3), names=[str(view) for view in range(20)])
    renderer = RefractiveModel(example_components()).eval()
    scoring.announce_scoring(renderer, views, ImageMetrics(["psnr"]), Subdivision(1), num_pixels=64)
    printed = capsys.readouterr().out
    assert line in printed
    assert ("trainer.limit_test_batches=5" in printed) == bool(line)


def scores(**given: float) -> dict[str, float | None]:
    return {name: given.get(name) for name in image_metrics()}


def result() -> EvaluationResult:
    views = (
        ViewScores(
            "test_000",
            scores(psnr=25.123456789012345, ssim=0.8, flip=0.25),
            {"mask": scores(psnr=22.0, ssim=0.7), "crop": scores(psnr=23.0)},
        ),
        ViewScores(
            "test_001",
            scores(psnr=27.0, ssim=0.9, flip=0.125),
            {"mask": scores(psnr=24.0), "crop": scores(psnr=26.0)},
        ),
    )
    return EvaluationResult(views, {"lpips": "no network", "mask.ssim": "masks too small"})


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


def test_file_contains_means_rows_and_budget(tmp_path: Path) -> None:
    write_metrics_json(tmp_path / "metrics.json", RunMetrics(result(), 1500, 312.5, 81000.0))
    content = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refuse)
    means = scores(psnr=(25.123456789012345 + 27.0) / 2, ssim=pytest.approx(0.85), flip=0.1875)
    assert content["test"] == means
    assert content["regions"] == {"mask": scores(psnr=23.0), "crop": scores(psnr=24.5)}  # SSIM: of one view only
    regions = {"mask": scores(psnr=22.0, ssim=0.7), "crop": scores(psnr=23.0)}
    full = scores(psnr=25.123456789012345, ssim=0.8, flip=0.25)
    assert content["views"][0] == {"name": "test_000", **full, "regions": regions}
    assert len(content["views"]) == 2
    assert (content["steps"], content["train_seconds"], content["rays_per_second"]) == (1500, 312.5, 81000.0)


@pytest.mark.parametrize("budget", [(1500, 312.5, 81000.0), (None, None, None)])
def test_read_returns_what_was_written(tmp_path: Path, budget: tuple) -> None:
    write_metrics_json(tmp_path / "metrics.json", RunMetrics(result(), *budget))
    assert read_metrics_json(tmp_path / "metrics.json") == RunMetrics(result(), *budget)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nan_and_infinity_are_refused_and_the_old_file_is_kept(tmp_path: Path, bad: float) -> None:
    path = tmp_path / "metrics.json"
    write_metrics_json(path, RunMetrics(result(), 1, 1.0, 1.0))
    before = path.read_text()
    refused("is NaN or infinite", write_metrics_json, path, RunMetrics(result(), 1, 1.0, bad))
    diverged = EvaluationResult((ViewScores("test_000", {"psnr": 20.0, "ssim": bad, "lpips": None}),))
    refused("is NaN or infinite", write_metrics_json, path, RunMetrics(diverged, 1, 1.0, 1.0))
    assert path.read_text() == before


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"views": [{"psnr": 3}]}',
        '{"views": [], "steps": -1, "train_seconds": 1, "rays_per_second": 1}',
        "\xff",
    ],
)
def test_damaged_files_give_a_one_line_error(tmp_path: Path, content: str) -> None:
    (tmp_path / "metrics.json").write_bytes(content.encode("latin-1"))
    refused(r"metrics\.json", read_metrics_json, tmp_path / "metrics.json")


def test_missing_file_names_the_next_step(tmp_path: Path) -> None:
    refused(r"does not exist.*run nerfro\.evaluate", read_metrics_json, tmp_path / "metrics.json")
