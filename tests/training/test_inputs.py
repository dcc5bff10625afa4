"""Inputs that a checkpoint does not contain: the surface of the object and the cameras of the photographs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from nerfro.core.cameras import Cameras
from nerfro.training.inputs import INPUTS, changed_file, inputs_of, require_same_inputs
from nerfro.training.load import load
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
    checkpoint = {INPUTS: inputs_of(config, cameras)}
    path = tmp_path / "last.ckpt"
    require_same_inputs(checkpoint, path, config, cameras)
    fewer = cameras.select([0, 1])
    refused("was trained on other photographs or cameras", require_same_inputs, checkpoint, path, config, fewer)
    dent(tmp_path / "inner.ply")
    assert changed_file(checkpoint, config) == "medium.bodies.water.mesh"
    refused(r"content of the file medium\.bodies\.water\.mesh", require_same_inputs, checkpoint, path, config, cameras)


def test_changed_surface_is_reported_in_loading_and_refused_in_resuming(
    train: Runner, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surface = Path(shutil.copy(tiny_scene / "mesh.ply", tmp_path / "mesh.ply"))
    train(*STEPS, f"medium.mesh={surface}")
    load(tmp_path / "run")
    assert "changed" not in capsys.readouterr().out
    dent(surface)
    load(tmp_path / "run")
    assert "the content of the file medium.mesh has changed since the training" in "".join(capsys.readouterr())
    resumed = train(*STEPS, f"medium.mesh={surface}", "trainer.max_steps=3", "ckpt_path=last", code=1)
    assert "was trained with another content of the file medium.mesh; restore" in resumed.error


def test_changed_photographs_are_refused_in_resuming(train: Runner, tiny_scene: Path, tmp_path: Path) -> None:
    data = shutil.copytree(tiny_scene, tmp_path / "data")
    options = [*STEPS, f"data.root={data}", f"medium.mesh={tiny_scene / 'mesh.ply'}"]
    train(*options)
    train(*options, "trainer.max_steps=3", "ckpt_path=last")
    file = data / "transforms_train.json"
    cameras = json.loads(file.read_text())
    file.write_text(json.dumps(cameras | {"frames": cameras["frames"][1:]}))
    resumed = train(*options, "trainer.max_steps=4", "ckpt_path=last", code=1)
    assert "was trained on other photographs or cameras than" in resumed.error
