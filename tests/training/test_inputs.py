"""Inputs that a checkpoint does not contain: the surface of the object and the cameras of the photographs."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf

from nerfro.core.cameras import Cameras
from nerfro.data.base import Views
from nerfro.data.formats.transforms import BlenderData
from nerfro.training.inputs import (
    INPUTS,
    changed_file,
    copy_files,
    inputs_of,
    recorded_cameras,
    relocated,
    require_files,
    require_same_inputs,
)
from nerfro.training.run_folder import load
from nerfro.viewing.page import page_split
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Runner, composed, refused

STEPS = ["trainer.max_steps=2", "evaluation.every=0", "evaluation.split=null"]


def dent(mesh: Path) -> None:
    """Change a surface within its bounds."""
    surface = trimesh.load_mesh(mesh)
    vertices = np.array(surface.vertices)
    vertices[np.abs(vertices).max(-1) < 0.75 * np.abs(vertices).max()] *= 0.97
    trimesh.Trimesh(vertices, surface.faces, process=False).export(mesh)


def test_files_of_the_medium_and_cameras_are_compared_with_a_checkpoint(tmp_path: Path) -> None:
    for name in ("mesh.ply", "inner.ply"):
        trimesh.creation.icosphere(2).export(tmp_path / name)
    bodies = f"{{glass: {{ior: 1.5}}, water: {{mesh: {tmp_path / 'inner.ply'}, ior: 1.3}}}}"
    config = composed(f"medium.mesh={tmp_path / 'mesh.ply'}", f"medium.bodies={bodies}")
    cameras = Cameras(torch.rand(3, 3, 4), *torch.rand(4, 3), 8, 8, 1.0, 2.0)
    views = Views(cameras, torch.zeros(3, 8, 8, 3), None, ["a", "b", "c"])
    checkpoint = {INPUTS: inputs_of(config, views)}
    path = tmp_path / "last.ckpt"
    require_same_inputs(checkpoint, path, config, views)
    fewer = views.select([0, 1])
    refused("was trained on other photographs or cameras", require_same_inputs, checkpoint, path, config, fewer)
    dent(tmp_path / "inner.ply")
    assert changed_file(checkpoint, config) == "medium.bodies.water.mesh"
    refused(r"content of the file medium\.bodies\.water\.mesh", require_same_inputs, checkpoint, path, config, views)


@pytest.mark.slow
def test_changed_surface_is_reported_in_loading_and_refused_in_resuming(
    train: Runner, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surface = Path(shutil.copy(tiny_scene / "mesh.ply", tmp_path / "mesh.ply"))
    train(*STEPS, f"medium.mesh={surface}")
    load(tmp_path / "run")
    assert "changed" not in capsys.readouterr().out
    dent(surface)
    load(tmp_path / "run")
    assert "changed" not in capsys.readouterr().out, "the run has a copy of the surface"
    shutil.rmtree(tmp_path / "run/inputs")
    load(tmp_path / "run")
    assert "the content of the file medium.mesh has changed since the training" in "".join(capsys.readouterr())
    resumed = train(*STEPS, f"medium.mesh={surface}", "trainer.max_steps=3", "ckpt_path=last", code=1)
    assert "was trained with another content of the file medium.mesh; restore" in resumed.error


def test_run_opens_anywhere_and_resumes_with_moved_data(
    train: Runner, command: Runner, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny_scene, "data")
    options = [*STEPS, "medium.mesh=${data.root}/mesh.ply"]
    train(*options, "data.root=data")
    trained = load("run")
    data, run = (Path(shutil.move(name, tmp_path / "elsewhere" / name)) for name in ("data", "run"))
    assert load(run).source.root == data, "a relative folder is searched around the run"
    data.rename(tmp_path / "moved")
    scene = load(run)
    torch.testing.assert_close(scene.cameras("train").camera_to_world, trained.cameras("train").camera_to_world)
    assert (scene.bounds == trained.bounds).all()
    refused("the data of the run, data, do not exist here; give root=FOLDER", scene.views)
    small = ["resolution=4", "subdivision.side=1", "device=cpu"]
    assert "2 frames" in command("render", f"checkpoint={run}", "path=orbit", "frames=2", "film=[]", "out=O", *small)
    assert "wrote" in command("export", f"checkpoint={run}", "resolution=8", "device=cpu", "what=page", "out=page.html")
    assert len(load(run, root="moved").views("test")) == 2
    shutil.rmtree(run / "inputs")
    refused(r"medium\.mesh=data/mesh\.ply of the run does not exist, .* give root=FOLDER", load, run)
    assert (load(run, root="moved").bounds == trained.bounds).all()
    resumed = [*options, "data.root=moved", "trainer.max_steps=3", f"hydra.run.dir={run}", "ckpt_path=last"]
    train(*resumed)
    photograph = tmp_path / "moved/train/r_1.png"
    shutil.copy(tmp_path / "moved/train/r_0.png", photograph)
    assert "was trained on other photographs" in train(*resumed, "trainer.max_steps=4", code=1).error


def test_files_of_a_run_are_found_in_its_folder_or_below_the_given_root(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mesh.ply", "inner.ply"):
        (tmp_path / "data").mkdir(exist_ok=True)
        trimesh.creation.icosphere(1).export(tmp_path / "data" / name)
    bodies = "{glass: {ior: 1.5}, water: {mesh: data/inner.ply, ior: 1.3}}"
    config = composed("data.root=data", "medium.mesh=${data.root}/mesh.ply", f"medium.bodies={bodies}")
    config = OmegaConf.create(OmegaConf.to_yaml(config, resolve=True))
    checkpoint, run = {INPUTS: inputs_of(config, None)}, tmp_path / "runs/first"
    copy_files(run, config)
    assert sorted(file.name for file in (run / "inputs").iterdir()) == [
        "medium.bodies.water.mesh.ply",
        "medium.mesh.ply",
    ]
    shutil.move("data", "elsewhere")
    moved = relocated(config, run)
    assert moved.medium.mesh == str(run / "inputs/medium.mesh.ply")
    assert moved.medium.bodies.water.mesh == str(run / "inputs/medium.bodies.water.mesh.ply")
    assert moved.data.root == "data", "unknown"
    assert changed_file(checkpoint, moved) is None
    require_files(checkpoint, moved)
    shutil.rmtree(run / "inputs")
    refused("of the run does not exist, and .* give root=FOLDER", require_files, checkpoint, relocated(config, run))
    moved = relocated(config, run, "elsewhere")
    assert (moved.data.root, moved.medium.bodies.water.mesh) == ("elsewhere", "elsewhere/inner.ply")
    assert changed_file(checkpoint, moved) is None
    shutil.move("elsewhere", "runs/data")
    assert relocated(config, run).medium.mesh == str(tmp_path / "runs/data/mesh.ply"), "searched around the run"


def test_scene_without_data_has_the_training_cameras(unchecked: None, tmp_path: Path) -> None:
    cameras = Cameras(torch.rand(3, 3, 4), *torch.rand(4, 3), 8, 6, 1.0, 2.0)
    renderer = SimpleNamespace(scene=SimpleNamespace(device=torch.device("cpu")))
    scene = TrainedScene(renderer, BlenderData(str(tmp_path / "gone")), training_cameras=cameras)  # type: ignore[arg-type]
    assert (scene.cameras("train").camera_to_world == cameras.camera_to_world).all()
    assert page_split(scene) == "train"
    refused("the data of the run, .*/gone, do not exist here; give root=FOLDER", scene.cameras, "test")


def test_damaged_records_of_cameras_are_ignored() -> None:
    cameras = Cameras(torch.rand(3, 3, 4), *torch.rand(4, 3), 8, 6, 1.0, 2.0)
    inputs = inputs_of(
        composed("sampler/path=straight"), Views(cameras, torch.zeros(3, 6, 8, 3), None, ["a", "b", "c"])
    )
    read = recorded_cameras({INPUTS: inputs})
    assert read is not None
    assert (read.width, read.height, read.near, read.far, read.distortion) == (8, 6, 1.0, 2.0, None)
    damages = ({"image": None}, {"image": {"width": 8}}, {"cameras": 3}, {"cameras": inputs["cameras"] | {"fx": [1.0]}})
    assert all(recorded_cameras({INPUTS: inputs | damage}) is None for damage in damages)
