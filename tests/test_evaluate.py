"""`python -m nerfro.evaluate predictions=... references=...`; scoring a checkpoint is tested in test_train.py."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from tests.conftest import Runner

HEIGHT, WIDTH = 24, 40


@pytest.fixture
def pictures(tmp_path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Predictions, references and masks of two views, written to folders of these names."""
    generator = np.random.default_rng(0)
    written = {}
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20:22, 18:22] = 255
    for name in ("glass", "pen"):
        prediction, reference = generator.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
        written[name] = prediction, reference
        for folder, image in (("predictions", prediction), ("references", reference), ("masks", mask)):
            (tmp_path / folder).mkdir(exist_ok=True)
            Image.fromarray(image).save(tmp_path / folder / f"{name}.png")
    return written


def test_folder_of_images_is_scored_in_every_region(
    tmp_path: Path, pictures: dict[str, tuple[np.ndarray, np.ndarray]], evaluate_here: Runner
) -> None:
    arguments = [f"{name}={tmp_path / name}" for name in ("predictions", "references", "masks")]
    out = evaluate_here(*arguments, f"out={tmp_path / 'out'}").out
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (content["steps"], content["train_seconds"]) == (None, None)
    assert [view["name"] for view in content["views"]] == ["glass", "pen"]
    for view in content["views"]:
        prediction, reference = pictures[view["name"]]
        assert view["psnr"] == pytest.approx(peak_signal_noise_ratio(reference, prediction), abs=1e-4)
        expected = peak_signal_noise_ratio(reference[20:22, 18:22], prediction[20:22, 18:22])
        assert view["regions"]["mask"]["psnr"] == pytest.approx(expected, abs=1e-4)
        expected = peak_signal_noise_ratio(reference[3:, 1:39], prediction[3:, 1:39])
        assert view["regions"]["crop"]["psnr"] == pytest.approx(expected, abs=1e-4)
    mean = sum(view["regions"]["crop"]["psnr"] for view in content["views"]) / 2
    assert content["regions"]["crop"]["psnr"] == pytest.approx(mean)
    assert content["notes"]["lpips"] == "images, masks or crops below 31 pixels"
    for name in ("metrics", "metrics_mask", "metrics_crop"):
        assert f"{content['views'][1]['name']}," in (tmp_path / "out" / f"{name}.csv").read_text()
    assert "pen" in out
    assert f"{mean:.2f}" in out
    for name in pictures:
        with Image.open(tmp_path / "out" / "errors" / f"{name}.png") as sheet:
            assert sheet.width > 5 * 256  # prediction, reference, squared error, SSIM, FLIP


def test_scores_are_written_beside_the_predictions_and_not_overwritten(
    tmp_path: Path, pictures: dict, evaluate_here: Runner
) -> None:
    folders = [f"predictions={tmp_path / 'predictions'}", f"references={tmp_path / 'references'}"]
    evaluate_here(*folders)
    assert (tmp_path / "predictions" / "scores" / "metrics.json").is_file()
    refused = evaluate_here(*folders, code=1).error
    assert "metrics.json exists; give another out=... or overwrite=true" in refused
    evaluate_here(*folders, "overwrite=true")


def test_damaged_image_is_refused_before_scoring(
    tmp_path: Path, pictures: dict, evaluate_here: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = tmp_path / "predictions" / "pen.png"
    last.write_bytes(last.read_bytes()[:100])
    folders = [f"predictions={tmp_path / 'predictions'}", f"references={tmp_path / 'references'}"]
    assert "pen.png cannot be read" in evaluate_here(*folders, code=1).error
    assert not (tmp_path / "predictions" / "scores").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either checkpoint="),
        (["checkpoint=a", "predictions=b"], "give either checkpoint="),
        (["predictions=b"], "predictions=b need references; give references=DIR"),
        (["checkpoint=a", "references=b"], "references=b has no effect with checkpoint=...; remove it"),
        (["checkpoint=a", "alpha=white"], "alpha=white has no effect with checkpoint=...; remove it"),
        (["predictions=a", "references=b", "root=c"], "root=c has no effect, because config.yaml does not exist"),
        (["predictions=a", "references=b", "split=val"], "split=val has no effect with predictions=...; remove it"),
        (["predictions=a", "references=b", "alpha=red"], "alpha='red' is not allowed; choose 'drop', 'white', 'black'"),
    ],
)
def test_contradictions_are_refused_in_one_line(arguments: list[str], message: str, evaluate_here: Runner) -> None:
    assert message in evaluate_here(*arguments, code=1).error


def test_images_of_a_run_match_the_photographs_of_its_data(
    trained_run: Path, tiny_scene: Path, tmp_path: Path, evaluate_here: Runner
) -> None:
    folders = [f"predictions={trained_run / 'images'}", f"references={tiny_scene / 'test'}"]
    evaluate_here(*folders, f"out={tmp_path}")
    run, again = (json.loads((folder / "metrics.json").read_text())["views"] for folder in (trained_run, tmp_path))
    assert [(view["name"], view["psnr"]) for view in again] == [(f["name"], pytest.approx(f["psnr"])) for f in run]


def test_images_of_a_run_with_a_moved_data_set_need_its_root(
    trained_run: Path, tiny_scene: Path, tmp_path: Path, evaluate_here: Runner
) -> None:
    run, config = tmp_path / "run", OmegaConf.load(trained_run / "config.yaml")
    config.data.root = str(tmp_path / "old")
    shutil.copytree(trained_run / "images", run / "images")
    OmegaConf.save(config, run / "config.yaml")
    folders = [f"predictions={run / 'images'}", f"references={tiny_scene / 'test'}", f"out={tmp_path / 'out'}"]
    error = evaluate_here(*folders, code=1).error
    assert f"have different names, and the data set that relates them cannot be loaded (data.root={tmp_path}" in error
    evaluate_here(*folders, f"root={tiny_scene}")
    shutil.copytree(run / "images", tmp_path / "same_names")
    evaluate_here(folders[0], f"references={tmp_path / 'same_names'}")
