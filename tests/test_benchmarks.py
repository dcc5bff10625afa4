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
from unittest.mock import ANY

import numpy as np
import pytest
import torch
import trimesh
from lightning.pytorch.callbacks import timer
from trimesh.exchange.gltf import export_glb

import nerfro
from benchmarks.capture import align_to_truth
from nerfro.files.images import save_png
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.kernels import available
from nerfro.poses.collection import extract_frames
from nerfro.train import main
from nerfro.training import run as training_run
from nerfro.viewing import server
from tests import ball_photographs
from tests.cameras_at import upright_cameras
from tests.conftest import refused
from tests.synthetic.test_gltf_scene import set_materials
from tests.viewing.browser import needs_chromium
from tests.viewing.test_exports import write

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
# Benchmarks that other tests run, and helpers.
ELSEWHERE = {"rounded_cube": "samplers/test_snell.py"}
PAPER = ("medium.resolution=48", "sampler.points.num_coarse=4", "sampler.points.num_fine=4", "batches.size=8")
SMALL = (
    "medium.resolution=24", "sampler.points.num_samples=4", "sampler.points.num_bins=8", "sampler.points.resolution=8",
    "field.num_levels=2", "field.log2_table_size=8", "background.resolutions=[4]", "batches.size=16",
    "phase.background.steps=0",
)  # fmt: skip

Run = Callable[..., list[str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run a benchmark as a script and return the lines that it prints, of which none holds NaN or infinity.

    Trainings that it starts run in this process, because imports would take most of their time.
    """

    processes = subprocess.run

    def train_here(command: list[str], **options: Any) -> Any:
        if command[0] != sys.executable:
            return processes(command, **options)
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["train", *(part for part in command if "=" in part)])
            main()
        return None

    def run_script(name: str, *arguments: object) -> list[str]:
        monkeypatch.syspath_prepend(str(FOLDER))
        monkeypatch.setattr(subprocess, "run", train_here)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        # Benchmarks replace these.
        replaced = ((timer, "time"), (ball_photographs, "SIZE"), (training_run, "Viewer"), (server, "_Handler"))
        for module, attribute in replaced:
            monkeypatch.setattr(module, attribute, getattr(module, attribute))
        capfd.readouterr()
        threads, gradients = torch.get_num_threads(), torch.is_grad_enabled()
        try:
            runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        finally:
            torch.set_num_threads(threads)
            torch.set_grad_enabled(gradients)
        printed = capfd.readouterr().out
        assert not re.search(r"\b(nan|inf)\b", printed)
        return printed.splitlines()

    return run_script


def table_rows(lines: list[str]) -> list[str]:
    """Return the rows of Markdown tables, headers included."""
    return [line for line in lines if re.match(r"\|(?!:?--)", line)]


def figures(lines: list[str]) -> dict[str, float]:
    """Return the numbers at the ends of lines by the names before them."""
    return {name.strip(): float(value) for name, value in (line.rsplit(maxsplit=1) for line in lines)}


def test_all_benchmarks_are_run_by_a_test() -> None:
    here = Path(__file__).read_text()
    for file in FOLDER.glob("*.py"):
        source = (Path(__file__).parent / ELSEWHERE[file.stem]).read_text() if file.stem in ELSEWHERE else here
        assert f'"{file.stem}"' in here
        assert file.stem in source


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "num_rows"),
    [
        (("step", "--turns", 1, "--options", *PAPER), 4),
        (("curve", "--steps", 2, "--rays", 4, "--options", *PAPER), 5),
        (("profile", "refractive", "--steps", 2, "--pixels", 16), 14),
        (("paths", "--turns", 1, "--steps", 2, "--options", *SMALL), 4),
        (("branches", "--turns", 1, "--steps", 2, "--options", *SMALL), 5),
    ],
    ids=["step", "curve", "profile", "paths", "branches"],
)
def test_training_benchmark_prints_complete_tables(part: tuple, num_rows: int, run: Run) -> None:
    assert len(table_rows(run("training", *part))) == num_rows


@pytest.mark.slow
def test_profile_of_a_step_lists_each_module_once(
    run: Run, tiny_default_run: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):  # which the benchmark sets
        monkeypatch.setenv(name, "1")
    lines = run("step_profile", *tiny_default_run)
    (summary,) = (line for line in lines if line.endswith(" returns"))
    modules, _, calls = (int(part.split()[0]) for part in summary.split(",")[:3])
    rows = [row for row in table_rows(lines) if row.startswith("| nerfro.")]
    assert len(rows) == modules == len({row.split("|")[1] for row in rows})
    assert sum(int(row.split("|")[2]) for row in rows) == calls > 100


def test_rendering_benchmark_prints_complete_tables(run: Run, trained_run: Path) -> None:
    assert (
        len(table_rows(run("training", "view", trained_run / "checkpoints" / "last.ckpt", "--side", 8, "--turns", 1)))
        == 10
    )


def test_gpu_benchmark_runs_to_its_end_without_a_gpu(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(available, "find_gpu", lambda: None)
    short = ("--steps", 1, "--goals", 1, 2, "--sides", 8, "--experiments", "straight", "--options", *SMALL[1:6])
    lines = run("gpu", "--out", tmp_path / "gpu.json", *short, "data.downscale=8", "batches.size=16")
    parts = json.loads((tmp_path / "gpu.json").read_text())
    assert parts["machine"]["gpu"] == parts["steps"]["straight"]["GPU, compiled"] == "n/a: no GPU"
    assert len(parts["results"]) == 17
    assert {cell for cells in parts["results"].values() for cell in cells.values()} == {"n/a: no GPU"}
    assert parts["steps"]["straight"]["1 core"]["step"] > 0
    assert parts["quality"]["PSNR at the end, dB"]["CPU"] > 2
    assert list(parts["views"]) == ["8x8, one ray a pixel, s", "8x8, supersampled, s"]
    assert parts["quality"]["seconds to 2 dB"] == {"GPU": "n/a: no GPU", "CPU": ANY}
    assert len(table_rows(lines)) == 32 + (torch.get_num_threads() > 1)


def test_processor_time_writes_a_finished_run(run: Run, tiny_default_run: list[str], tmp_path: Path) -> None:
    options = [*tiny_default_run, "trainer.max_steps=2", "trainer.max_time=00:00:01:00"]
    run("processor_time", *options, f"hydra.run.dir={tmp_path}/run")
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 2


def test_comparison_keeps_finished_rows_and_repeats_interrupted_ones(
    run: Run, tiny_default_run: list[str], tmp_path: Path
) -> None:
    affinity = os.sched_getaffinity(0)
    rest = ["--rows", "refractive", "--out", tmp_path, "--options", *tiny_default_run, "trainer.max_steps=2"]
    interrupted = tmp_path / "00000001" / "refractive"
    (interrupted / "checkpoints").mkdir(parents=True)
    (interrupted / "checkpoints" / "of_an_interrupted_run.ckpt").touch()
    (row,) = table_rows(run("comparison", "00:00:00:01", *rest))[1:]
    assert not (interrupted / "checkpoints" / "of_an_interrupted_run.ckpt").exists()
    (interrupted / "finished").touch()
    assert table_rows(run("comparison", "00:00:00:01", *rest))[1:] == [row]
    assert (interrupted / "finished").exists()
    assert os.sched_getaffinity(0) == affinity


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "num_rows"),
    [
        (("tracing", "--resolution", 48, "--euler-resolution", 48, "--side", 16, "--rays", 16), 34),
        (("peers", "--turns", 1, "--steps", 2, "--paper-steps", 2, "--paper-options", *PAPER, "--options", *SMALL), 6),
        (("installation", "--turns", 1, "--starts", "import nerfro", "--least", 1e4), 6),
    ],
    ids=lambda arguments: arguments[0] if isinstance(arguments, tuple) else None,
)
def test_tables_of_optics_and_kernels_are_complete(arguments: tuple, num_rows: int, run: Run) -> None:
    assert len(table_rows(run(*arguments))) == num_rows


@pytest.mark.slow
def test_figures_of_optics_are_written(run: Run, tmp_path: Path) -> None:
    run("optics_pictures", "--folder", tmp_path, "--resolution", 48, "--side", 8)
    assert len(list(tmp_path.glob("optics_*.png"))) == 5
    run("concept_figures", "--folder", tmp_path, "--downscale", 8)
    assert len(list(tmp_path.glob("concept_*.png"))) == 4


def test_error_budget_prints_every_class(run: Run, trained_run: Path) -> None:
    assert len(table_rows(run("error_budget", trained_run, "--views", 1))) == 6


def test_vessel_prints_two_errors_of_every_simpler_medium(run: Run) -> None:
    lines = run("vessel", "--rays", 200, "--resolution", 32)
    rows = [re.fullmatch(r"(.{24}) +[\d.]+ +\d+% +[\d.]+ +\d+%", line) for line in lines[2:]]
    assert len(rows) == 9
    assert all(rows)


@pytest.mark.slow
def test_water_benchmark_prints_a_row_for_each_scene(run: Run) -> None:
    rows = table_rows(run("water", "--rays", 8))
    assert [row.split("|")[1].strip() for row in rows] == ["tank", "pool", "case", "jar"]


def test_hull_benchmark_finds_no_error_in_the_true_surface(run: Run, tiny_scene: Path) -> None:
    measured = figures(run("hull", tiny_scene, tiny_scene / "mesh.ply"))
    assert len(measured) == 5
    assert measured["volume, intersection over union"] == measured["volume, ratio"] == 1
    assert measured["exit directions, mean error in degrees"] == 0


def test_hull_benchmark_aligns_the_true_surface_of_a_capture(run: Run, tmp_path: Path) -> None:
    """The estimated world is another than the true one, and the photographs are copies in another folder."""
    capture = write_capture(tmp_path / "capture")
    measured = figures(run("hull", capture, capture / "mesh.ply", "--format", "opencv"))
    assert len(measured) == 5
    assert measured["volume, intersection over union"] > 0.99
    assert measured["volume, ratio"] == pytest.approx(1, abs=1e-3)
    assert measured["normals, mean error in degrees"] < 3
    assert measured["exit directions, mean error in degrees"] < 0.1


def test_capture_benchmark_finds_no_error_in_cameras_of_another_world(run: Run, tmp_path: Path) -> None:
    measured = figures(run("capture", write_capture(tmp_path / "capture")))
    assert measured["photographs with a pose"] == measured["photographs"] == 6
    assert measured["rotation, largest error in degrees"] < 1e-3
    assert measured["position, largest error in % of the distance"] < 1e-3
    assert measured["hull, intersection over union with the object"] > 0.99


def test_alignment_needs_three_photographs_with_true_poses(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture")
    (capture / "truth" / "transforms_test.json").unlink()
    refused("truth has no pose of 4.png", align_to_truth, capture, capture)
    (capture / "transforms_train.json").unlink()
    refused("has 2 cameras; the alignment needs three or more", align_to_truth, capture, capture)


def write_capture(root: Path) -> Path:
    """Write a capture with true cameras and surface, and estimated ones that differ by a similarity transformation."""
    body = trimesh.creation.icosphere(3, 0.6).apply_scale([1.0, 0.7, 0.5])
    scale, shift = 0.4, np.array([3.0, -1.0, 0.5])
    rotation = trimesh.transformations.rotation_matrix(1.1, [0.3, -0.9, 0.4])[:3, :3]
    poses = upright_cameras(6, 16, 20.0).camera_to_world.double().numpy() * [1, -1, -1, 1]  # axes of OpenCV
    estimated = np.concatenate([rotation @ poses[..., :3], (scale * poses[..., 3] @ rotation.T + shift)[..., None]], -1)
    for folder, images, of_folder in ((root / "truth", "photographs", poses), (root, "images", estimated)):
        (folder / images).mkdir(parents=True)
        for split, views in (("train", range(4)), ("test", range(4, 6))):
            frames = []
            for view in views:
                save_png(folder / images / f"{view}.png", torch.full((16, 16, 3), 0.5))
                pose = [*of_folder[view].tolist(), [0.0, 0.0, 0.0, 1.0]]
                frames.append({"file_path": f"{images}/{view}.png", "transform_matrix": pose})
            document = {"cam_mat": [[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]], "frames": frames}
            (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    TriangleMesh(body.vertices, body.faces).save(root / "truth" / "mesh.ply")
    TriangleMesh(scale * body.vertices @ rotation.T + shift, body.faces).save(root / "mesh.ply")
    return root


@pytest.mark.slow
def test_cameras_benchmark_writes_its_runs(
    run: Run, tiny_default_run: list[str], tiny_scene: Path, tmp_path: Path
) -> None:
    options = [*tiny_default_run[1:], "trainer.max_steps=2"]
    lines = run("cameras", "--root", tiny_scene, "--out", tmp_path, "--rows", "true", "refined", "--", *options)
    true, refined = (line.split() for line in lines if line.startswith(("true", "refined")))
    assert len(true) == len(refined) == 10
    assert [float(error) for error in true[4:]] == [0] * 6
    assert float(refined[5]) > 0
    assert sorted(file.parent.name for file in tmp_path.glob("*/metrics.json")) == ["refined", "true"]


@pytest.mark.slow
def test_memory_benchmark_prints_a_complete_table(run: Run, tiny_default_run: list[str]) -> None:
    options = [option for option in tiny_default_run if not option.startswith("data.root")]
    assert len(table_rows(run("memory", "2x8x8", "--steps", 2, "--options", *options))) == 4


@pytest.mark.slow
def test_scaling_benchmark_prints_tables_and_draws_its_figure(
    run: Run, tiny_default_run: list[str], tmp_path: Path
) -> None:
    options = [option for option in tiny_default_run if not option.startswith(("data.root", "trainer."))]
    arguments = ("--steps", 2, "--figure", tmp_path / "scaling.png", "pixels=8,16", "--options", *options)
    assert len(table_rows(run("scaling", *arguments))) == 5
    assert (tmp_path / "scaling.png").stat().st_size > 0


@pytest.mark.slow
@needs_chromium
def test_page_benchmark_counts_fetches_of_each_texture(run: Run, trained_run: Path) -> None:
    lines = run("page", trained_run, "--views", 0, "--size", 16, "--resolution", 16, "--turns", 1)
    _, view, mean = table_rows(lines)
    fetches, coefficients, *others = map(float, view.split("|")[2:7])
    assert abs(fetches - coefficients - sum(others)) < 3
    assert view.split("|")[2:] == mean.split("|")[2:]
    # A search for a root evaluates the signed distance often, and fetches coefficients only in new cells.
    assert 0 < coefficients < 150


@pytest.mark.slow
@needs_chromium
def test_live_page_benchmark_prints_the_cost_of_a_browser(run: Run, tiny_default_run: list[str]) -> None:
    lines = run("live_page", "--seconds", 20, "--window", 5, "--options", *tiny_default_run, "trainer.max_steps=-1")
    assert len(table_rows(lines)) == 5


@pytest.mark.usefixtures("mitsuba")
def test_mitsuba_export_benchmark_compares_with_mitsuba(run: Run, trained_run: Path, tmp_path: Path) -> None:
    write(nerfro.load(trained_run), "mitsuba", tmp_path / "scene.xml")
    assert (
        len(table_rows(run("mitsuba_export", trained_run, tmp_path / "scene.xml", "--views", 0, "--samples", 1))) == 3
    )


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
def test_scenes_of_other_people_are_data_sets_with_bodies(run: Run, tmp_path: Path) -> None:
    profile = [[0.0, 0.0], [0.4, 0.0], [0.5, 1.6], [0.46, 1.6], [0.36, 0.1], [0.0, 0.1]]
    shapes = {"glass": trimesh.creation.revolve(profile, sections=24)}
    opaque = "straw", "straw_2", "straw_001", "straw_001_2", "flowers", "cake"
    for name in opaque:
        shapes[name] = trimesh.creation.box((0.1, 0.1, 0.3))
    scene, turn = trimesh.Scene(), np.eye(4)
    turn[:3, :3] = Z_UP_TO_Y_UP
    for name, shape in shapes.items():
        scene.add_geometry(shape, geom_name=name, node_name=name, transform=turn)
    content = export_glb(scene, tree_postprocessor=lambda tree: set_materials(tree, opaque))
    (tmp_path / "assets.glb").write_bytes(content)
    save_png(tmp_path / "sky.png", torch.rand(8, 16, 3))
    for name, bodies in {"straw": ["glass", "water"], "amber": ["amber"]}.items():
        folder, short = tmp_path / name, ("--width", 16, "--views", 2, 1, 1, "--spp", 2, 2, 2)
        run("other_scenes", name, tmp_path / "assets.glb", tmp_path / "sky.png", folder, *short)
        assert len(list((folder / "train").iterdir())) == len(list((folder / "train_mask").iterdir())) == 2
        assert all(load_mesh(folder / f"{body}.ply").is_closed for body in bodies)
        assert list(json.loads((folder / "meta.json").read_text())["bodies"]) == bodies


def test_glassware_benchmark_renders_and_scores_a_perfect_reconstruction(
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
    (row,) = table_rows(run("glassware", "jar", jar, "--reconstruction", perfect))[1:]
    assert row.startswith("| jar | 4 | 0.00° | 1.000, 1.000 |")
