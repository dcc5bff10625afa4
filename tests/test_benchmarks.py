"""Every benchmark runs to its end with tiny settings and prints complete tables."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import timer

import nerfro.train
from nerfro.evaluation.metrics import ImageMetrics
from tests import ball_photographs
from tests.poses.camera_calibration import extract_frames
from tests.viewing.test_exports import write

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
# Benchmarks that other tests run, and helpers.
ELSEWHERE = {"capture": "test_capture.py", "rounded_cube": "samplers/test_snell.py"}
PAPER = ("medium.resolution=48", "sampler.points.num_coarse=4", "sampler.points.num_fine=4", "batches.size=8")
SMALL = (
    "medium.resolution=24", "sampler.points.num_samples=4", "sampler.points.num_bins=8", "sampler.points.resolution=8",
    "field.num_levels=2", "field.log2_table_size=8", "boundary.resolutions=[4]", "batches.size=16",
    "phase.background.steps=0",
)  # fmt: skip

Run = Callable[..., list[str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run a benchmark as a script and return the lines of its tables.

    Trainings that it starts run in this process, because imports would take most of their time.
    """

    processes = subprocess.run

    def train_here(command: list[str], **options: Any) -> Any:
        if command[0] != sys.executable:
            return processes(command, **options)
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["train", *(part for part in command if "=" in part)])
            nerfro.train.main()
        return None

    def run_script(name: str, *arguments: object) -> list[str]:
        monkeypatch.syspath_prepend(str(FOLDER))
        monkeypatch.setattr(subprocess, "run", train_here)
        monkeypatch.setattr(nerfro.train, "prepared_metrics", ImageMetrics)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        # Benchmarks replace these.
        for module, attribute in ((timer, "time"), (ball_photographs, "SIZE")):
            monkeypatch.setattr(module, attribute, getattr(module, attribute))
        capfd.readouterr()
        threads, gradients = torch.get_num_threads(), torch.is_grad_enabled()
        try:
            runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        finally:
            torch.set_num_threads(threads)
            torch.set_grad_enabled(gradients)
        lines = [line for line in capfd.readouterr().out.splitlines() if re.match(r"\|(?!:?--)", line)]
        assert not re.search(r"\b(nan|inf)\b", "\n".join(lines))
        return lines

    return run_script


def test_all_benchmarks_are_run_by_a_test() -> None:
    here = Path(__file__).read_text()
    for file in FOLDER.glob("*.py"):
        source = (Path(__file__).parent / ELSEWHERE[file.stem]).read_text() if file.stem in ELSEWHERE else here
        assert f'"{file.stem}"' in here
        assert file.stem in source


@pytest.mark.parametrize(
    ("part", "num_rows"),
    [
        (("step", "--turns", 1, "--options", *PAPER), 4),
        (("curve", "--steps", 2, "--rays", 4, "--options", *PAPER), 5),
        (("profile", "paper_fast", "--steps", 2, "--pixels", 16, "--options", *PAPER), 14),
        (("paths", "--turns", 1, "--steps", 2, "--options", *SMALL), 4),
        (("branches", "--turns", 1, "--steps", 2, "--options", *SMALL), 5),
    ],
    ids=["step", "curve", "profile", "paths", "branches"],
)
def test_training_is_timed_in_every_part(part: tuple, num_rows: int, run: Run) -> None:
    assert len(run("training", *part)) == num_rows


def test_rendering_is_timed(run: Run, trained_run: Path) -> None:
    assert len(run("training", "view", trained_run / "checkpoints" / "last.ckpt", "--side", 8, "--turns", 1)) == 10


def test_trainings_with_a_time_budget_are_tabulated(run: Run, tiny_default_run: list[str], tmp_path: Path) -> None:
    options = [*tiny_default_run, "trainer.max_steps=2", "trainer.max_time=00:00:01:00"]
    assert len(run("processor_time", *options, f"hydra.run.dir={tmp_path}/run")) == 0
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_comparison_keeps_finished_rows_and_repeats_interrupted_ones(
    run: Run, tiny_default_run: list[str], tmp_path: Path
) -> None:
    affinity = os.sched_getaffinity(0)
    rest = ["--rows", "refractive", "--out", tmp_path, "--options", *tiny_default_run, "trainer.max_steps=2"]
    interrupted = tmp_path / "00000001" / "refractive"
    (interrupted / "checkpoints").mkdir(parents=True)
    (interrupted / "checkpoints" / "of_an_interrupted_run.ckpt").touch()
    (row,) = run("comparison", "00:00:00:01", *rest)[1:]
    assert not (interrupted / "checkpoints" / "of_an_interrupted_run.ckpt").exists()
    (interrupted / "finished").touch()
    assert run("comparison", "00:00:00:01", *rest)[1:] == [row]
    assert (interrupted / "finished").exists()
    assert os.sched_getaffinity(0) == affinity


@pytest.mark.parametrize(
    ("arguments", "num_rows"),
    [
        (("tracing", "--resolution", 48, "--euler-resolution", 48, "--side", 16, "--rays", 16), 34),
        (("vessel", "--rays", 200, "--resolution", 32), 0),
        (("peers", "--turns", 1, "--steps", 2, "--paper-steps", 2, "--paper-options", *PAPER, "--options", *SMALL), 6),
        (("installation", "--turns", 1, "--starts", "import nerfro", "--least", 1e4), 6),
    ],
    ids=lambda arguments: arguments[0] if isinstance(arguments, tuple) else None,
)
def test_tables_of_optics_and_kernels_are_complete(arguments: tuple, num_rows: int, run: Run) -> None:
    assert len(run(*arguments)) == num_rows


def test_pictures_of_optics_are_drawn(run: Run, tmp_path: Path) -> None:
    run("optics_pictures", "--folder", tmp_path, "--resolution", 48, "--side", 8)
    assert len(list(tmp_path.glob("optics_*.png"))) == 5
    run("concept_figures", "--folder", tmp_path, "--downscale", 8)
    assert len(list(tmp_path.glob("concept_*.png"))) == 4


def test_errors_of_a_run_are_put_into_classes(run: Run, trained_run: Path) -> None:
    assert len(run("error_budget", trained_run, "--views", 1)) == 6


def test_hulls_are_measured(run: Run, tiny_scene: Path) -> None:
    run("hull", tiny_scene, tiny_scene / "mesh.ply")


def test_cameras_come_back(run: Run, tiny_default_run: list[str], tiny_scene: Path, tmp_path: Path) -> None:
    options = [*tiny_default_run[1:], "trainer.max_steps=2"]
    run("cameras", "--root", tiny_scene, "--out", tmp_path, "--rows", "true", "refined", "--", *options)
    assert len(list(tmp_path.glob("*/metrics.json"))) == 2


@pytest.mark.slow
def test_memory_of_a_training_is_measured(run: Run, tiny_default_run: list[str]) -> None:
    options = [option for option in tiny_default_run if not option.startswith("data.root")]
    assert len(run("memory", "2x8x8", "--steps", 2, "--options", *options)) == 2


@pytest.mark.slow
def test_growth_of_the_costs_is_measured(run: Run, tiny_default_run: list[str], tmp_path: Path) -> None:
    options = [option for option in tiny_default_run if not option.startswith(("data.root", "trainer."))]
    arguments = ("--steps", 2, "--figure", tmp_path / "scaling.png", "pixels=8,16", "--options", *options)
    assert len(run("scaling", *arguments)) == 5
    assert (tmp_path / "scaling.png").stat().st_size > 0


@pytest.mark.usefixtures("mitsuba")
def test_mitsuba_renders_beside_a_run(run: Run, trained_run: Path, tmp_path: Path) -> None:
    write(nerfro.load(trained_run), "mitsuba", tmp_path / "scene.xml")
    assert len(run("mitsuba_export", trained_run, tmp_path / "scene.xml", "--views", 0, "--samples", 1)) == 3


@pytest.mark.usefixtures("mitsuba")
def test_glassware_is_rendered_and_a_perfect_reconstruction_is_scored(
    run: Run, trained_run: Path, tmp_path: Path
) -> None:
    for kind in ("bottle", "jar", "tumbler", "wine"):
        run("glassware", kind, tmp_path / kind, "--photographs", 4, "--width", 24, "--spp", 1)
        assert len(json.loads((tmp_path / kind / "outlines.json").read_text())) == 3
    jar, perfect = tmp_path / "jar", tmp_path / "perfect"
    names = {file.stem for file in (jar / "images").iterdir()}
    assert {file.stem for file in extract_frames(jar / "film.mp4", tmp_path / "frames", 4)} == names
    shutil.copytree(jar / "images", perfect / "images")
    for name in names:
        shutil.copy(jar / "masks" / f"{name}.png", perfect / "images" / f"mask_{name}.png")
    cameras = (jar / "truth" / "transforms_train.json").read_text()
    cameras = cameras.replace("../masks/", "images/mask_").replace("../", "")
    (perfect / "transforms_train.json").write_text(cameras)
    (perfect / "run").symlink_to(trained_run)
    (row,) = run("glassware", "jar", jar, "--reconstruction", perfect)[1:]
    assert row.startswith("| jar | 4 | 0.00° | 1.000, 1.000 |")
