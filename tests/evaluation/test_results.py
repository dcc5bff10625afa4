import json
import math
from pathlib import Path

import pytest

from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import (
    EvaluationResult,
    RunMetrics,
    ViewScores,
    read_metrics_json,
    write_metrics_json,
)
from tests.conftest import refused


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
