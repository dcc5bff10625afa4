"""A complete training run, its files, and evaluations of checkpoints and of folders of images."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from nerfro.data.formats.transforms import BlenderData
from nerfro.training.run_folder import LAST_CHECKPOINT
from tests.conftest import UTM, Runner, moved_mesh, train_in, weights_of


@pytest.fixture(scope="module")
def overrides(tiny_run: list[str]) -> list[str]:
    return [
        *tiny_run,
        "trainer.max_steps=6",
        "evaluation.every=4",
        "loss.background.start=2",
        "loss.smoothness.start=3",
    ]


@pytest.fixture(scope="module")
def run(overrides: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run."""
    folder = tmp_path_factory.mktemp("train") / "run"
    return train_in(folder, *overrides, "logger=tensorboard", "trainer.log_every_n_steps=2")


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_run_writes_metrics_images_and_its_configuration(run: Path, overrides: list[str], tiny_scene: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert {"test", "views", "steps", "train_seconds", "rays_per_second"} <= metrics.keys()
    assert {"psnr", "ssim", "lpips"} <= metrics["test"].keys()
    assert metrics["steps"] == 6
    assert metrics["test"]["lpips"] is None
    assert [view["name"] for view in metrics["views"]] == ["test_000", "test_001"]
    assert metrics["test"]["psnr"] == pytest.approx(np.mean([view["psnr"] for view in metrics["views"]]))
    assert metrics["rays_per_second"] == pytest.approx(6 * 32 / metrics["train_seconds"])

    pictures = sorted((run / "images").iterdir())
    assert [path.name for path in pictures] == ["test_000.png", "test_001.png"]
    references = BlenderData(str(tiny_scene)).load("test").images
    for path, reference, view in zip(pictures, references, metrics["views"], strict=True):
        picture = read(path)
        assert picture.shape == (16, 16, 3)
        assert picture.dtype == np.uint8
        # The score of the written picture is the score that is reported.
        error = np.mean((picture / 255 - reference.double().numpy()) ** 2)
        assert view["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)

    config = OmegaConf.load(run / "config.yaml")
    assert config.field.width == 8
    assert config.medium.mesh == f"{tiny_scene}/mesh.ply", "interpolations are resolved"
    facts = json.loads((run / "run.json").read_text())
    assert facts["seed"] == 0
    assert any(line.startswith("BackgroundSettings(max_pixels=8, ") for line in facts["algorithms"])
    assert torch.__version__.startswith(facts["versions"]["torch"])  # the wheel may lack the suffix +cu130
    assert all(override in facts["command"] for override in overrides if "{" not in override)


def test_georeferenced_data_train_as_at_the_origin(
    run: Path, train_here: Runner, overrides: list[str], tiny_scene: Path, tmp_path: Path
) -> None:
    root = tmp_path / "utm"
    shutil.copytree(tiny_scene, root)
    mesh = moved_mesh(trimesh.load(root / "mesh.ply"), UTM, root / "mesh.obj")
    for file in root.glob("*.json"):
        document = json.loads(file.read_text())
        for frame in document["frames"]:
            for row, shift in zip(frame["transform_matrix"], UTM, strict=False):
                row[3] += shift
        file.write_text(json.dumps(document))
    box = [
        f"medium.box_{end}={[x + side for x in UTM]}".replace(" ", "") for end, side in (("min", -1.5), ("max", 1.5))
    ]
    far = [f"data.root={root}", f"medium.mesh={mesh}", *box]
    train_here(*overrides, *far, "--cfg", "job")  # is not refused
    train_here(*overrides, *far, f"hydra.run.dir={tmp_path / 'far'}")
    psnr = [json.loads((folder / "metrics.json").read_text())["test"]["psnr"] for folder in (run, tmp_path / "far")]
    assert psnr[1] == pytest.approx(psnr[0], abs=0.01)
    apart = [f"data.root={root}", f"hydra.run.dir={tmp_path / 'apart'}"]
    refused = train_here(*overrides, *apart, code=1).error
    assert "too far from the origin for single precision; subtract this point" in refused


def test_log_contains_every_loss_and_weight_of_every_second_step_and_images(run: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run / "tensorboard")).Reload()

    def logged(name: str) -> list[tuple[int, float]]:
        return [(event.step, event.value) for event in events.Scalars(name)]

    rate = "optimizer/learning_rate/common"
    for name in ("loss/total", "loss/photometric", "train/psnr", "train/rays_per_second", rate):
        assert [step for step, _ in logged(name)] == [0, 1, 3, 5], name
    assert logged("weight/background") == [(0, 0), (1, 0), (3, pytest.approx(0.025)), (5, pytest.approx(0.025))]
    assert logged("weight/smoothness") == [(0, 0), (1, 0), (3, 1), (5, 1)]
    assert [step for step, _ in logged("loss/background")] == [3, 5]
    assert "val/psnr" in events.Tags()["scalars"]
    assert "epoch" not in events.Tags()["scalars"]
    assert "custom_scalars__config__" in events.Tags()["tensors"]
    assert {"val/prediction_reference_error", "val/depth_opacity"} <= set(events.Tags()["images"])


def test_weights_depend_on_the_seed_and_not_on_validation(
    run: Path, train_here: Runner, overrides: list[str], tmp_path: Path
) -> None:
    weights = [weights_of(run)]
    for seed in (0, 1):
        folder = tmp_path / str(seed)
        train_here(*overrides, f"hydra.run.dir={folder}", f"seed={seed}", "evaluation.every=0")
        weights.append(weights_of(folder))
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert not all(torch.equal(weights[0][key], weights[2][key]) for key in weights[0])


def test_training_learns_the_scene(train_paper: Runner, tmp_path: Path) -> None:
    psnr = []
    quick = ["evaluation.every=0", "optimizer.warmup_steps=0", "optimizer.learning_rate=1e-2", "batches.size=128"]
    for steps in (1, 150):
        folder = tmp_path / str(steps)
        train_paper(*quick, f"trainer.max_steps={steps}", f"hydra.run.dir={folder}")
        psnr.append(json.loads((folder / "metrics.json").read_text())["test"]["psnr"])
    assert psnr[1] > psnr[0] + 3


def test_evaluation_of_the_checkpoint_equals_that_of_the_run(run: Path, evaluate_here: Runner) -> None:
    evaluate_here(f"checkpoint={run}")
    again = run / "evaluate_test"
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (run, again))
    assert first["views"] == second["views"]
    assert first["steps"] == second["steps"]
    assert first["rays_per_second"] == pytest.approx(second["rays_per_second"])
    for name in ("test_000.png", "test_001.png"):
        assert np.array_equal(read(run / "images" / name), read(again / "images" / name))
        assert (again / "errors" / name).is_file()


def test_scores_of_a_checkpoint_outside_of_a_run_are_beside_it(
    run: Path, evaluate_here: Runner, tmp_path: Path
) -> None:
    (tmp_path / "best").mkdir()
    shutil.copy(run / LAST_CHECKPOINT, tmp_path / "best" / "step9.ckpt")
    evaluate_here(f"checkpoint={tmp_path / 'best' / 'step9.ckpt'}")
    assert (tmp_path / "best" / "evaluate_test" / "metrics.json").is_file()


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
