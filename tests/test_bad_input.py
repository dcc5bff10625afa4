"""Input that cannot be trained on is refused in one line, before training starts and with nothing written."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hydra.errors import HydraException
from PIL import Image

from nerfro.cli.failures import in_one_line
from tests.conftest import Runner
from tests.data.formats import change_json


def put_pose(value: float) -> Callable[[dict[str, Any]], None]:
    def put(document: dict[str, Any]) -> None:
        document["frames"][1]["transform_matrix"][0][3] = value

    return put


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def open_mesh(root: Path) -> None:
    mesh = trimesh.load(root / "mesh.ply", force="mesh")
    mesh.faces = mesh.faces[1:]
    mesh.export(root / "mesh.ply")


def tiny_mesh(root: Path) -> None:
    trimesh.creation.icosphere(2, 2e-5).export(root / "mesh.ply")


def flat_mesh(root: Path) -> None:
    box = trimesh.creation.box()
    trimesh.Trimesh(box.vertices * (1, 1, 0), box.faces, process=False).export(root / "mesh.ply")


def large_mesh(root: Path) -> None:
    trimesh.creation.icosphere(2, 1.49).export(root / "mesh.ply")


def wrong_size(root: Path) -> None:
    Image.fromarray(np.zeros((16, 12, 3), np.uint8)).save(root / "train" / "r_1.png")


DAMAGES: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "no json": (lambda root: (root / "transforms_train.json").unlink(), ["train"]),
    "truncated json": (lambda root: truncate(root / "transforms_train.json"), ["transforms_train.json"]),
    "truncated test image": (lambda root: truncate(root / "test" / "r_1.png"), ["test", "r_1.png"]),
    "wrong size": (wrong_size, ["r_1", "12", "16"]),
    "pose of 400 digits": (
        lambda root: change_json(root / "transforms_train.json", put_pose(10**400)),
        ["r_1", "infinite"],
    ),
    "deep json": (lambda root: (root / "transforms_train.json").write_text("[" * 5000), ["is not valid JSON"]),
    "no mesh": (lambda root: (root / "mesh.ply").unlink(), ["mesh.ply does not exist"]),
    "unreadable mesh": (lambda root: (root / "mesh.ply").write_bytes(b"ply?"), ["mesh.ply"]),
    "open mesh": (open_mesh, ["not watertight", "medium.accept_open_mesh=true"]),
    "flat mesh": (flat_mesh, ["0 world units thin and 1 long, so it has no inside"]),
    "mesh as small as a speck": (tiny_mesh, ["no vertex of the grid lies inside the mesh"]),
    "object outside the box": (large_mesh, ["does not fit into the box", "medium.box_min=[", "medium.box_max=["]),
}


@pytest.fixture
def require_refusal(train_paper: Runner, tmp_path: Path) -> Callable[..., None]:
    """Require that a training is refused with some words, before anything is written."""

    def require(words: list[str], *overrides: str) -> None:
        refused = train_paper("trainer.max_steps=1", *overrides, code=1).error
        for word in words:
            assert word in refused
        assert not list((tmp_path / "run").rglob("*"))

    return require


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_data_is_refused(
    damage: str, require_refusal: Callable[..., None], tiny_scene: Path, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny_scene, root)
    break_it, words = DAMAGES[damage]
    break_it(root)
    require_refusal(words, f"data.root={root}")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["data.near=5"], ["data.near=5 lies behind the object, which the rays meet at distances from 3."]),
        (["data.far=2.5"], ["data.far=2.5 lies before the object", "set data.near and data.far around these"]),
        (["evaluation.split=night"], ["no split 'night'; it has train, val, test"]),
        (["data.root=/"], ["data.root=/ is a whole file system; give a folder below it"]),
        (["trainer.max_time=5"], ["trainer.max_time=5 is not a duration", "write 90s, 5m, 1h"]),
        (["batches.size=1e12"], ["batches.size=1000000000000.0 is not allowed; take an integer, at least 1"]),
        (["sampler.path=nothing"], ["'nothing' is not a set of settings"]),
        (["trainer.accumulate_grad_batches=2"], ["trainer.accumulate_grad_batches=2 is not allowed; batches depend"]),
        (["+trainer.limit_train_batches=0"], ["trainer.limit_train_batches=0 is not allowed; a run has no epochs"]),
        (["--shell-completion"], ["Expecting one subcommand from ['install', 'uninstall', 'query']"]),
        (["batches.size=100000", "batches.batching=single_image"], ["batch_size=100000 exceeds the 16x16 pixels"]),
        (["nme=x"], ["nme is not a setting; did you mean name?"]),
        (["field=nrf"], ["Could not find 'field/nrf'", "Available options", "mip_nerf", "nerf"]),
        (["loss.opaque.start=1"], ["write +loss.opaque.weight=..., with a plus sign"]),
        (["+loss.photometric.weight=1"], ["loss.photometric.weight has a value already", "without a plus sign"]),
        (["callbacks.early_stopping.patience=2"], ["not selected; add +callbacks=early_stopping"]),
        (["field.widht=3"], ["field.widht is not a setting; did you mean width?"]),
        (
            ["field=nerf", "+field.log2_table_size=1"],
            ["field.log2_table_size is not a setting; known: depth, position"],
        ),
        (["+expriment=mipnerf"], ["expriment is not a setting; did you mean experiment?"]),
        (["+batches.foo=3"], ["batches.foo is not a setting; known: batching, num_validation_views"]),
        (["+sampler.point.num_samples=5"], ["sampler.point is not a setting; did you mean points?"]),
        (["+hydra.run.foo=1"], ["hydra.run.foo is not a setting; known: dir"]),
        (["field.width=abc"], ["field=nerf: width='abc' is not allowed; take a number, not text"]),
        (["field=null"], ["Got NoneType; give the name of an option"]),
        (["+loss.boundry.weight=1"], ["no loss is called 'boundry'; known: backdrop, background"]),
        (["field._target_=os.system"], ["'os.system' is not registered"]),
        (["trainer._target_=os.system"], ["'os.system' is not registered"]),
        (["logger=none", "+logger.x={_target_: os.system, command: 'false'}"], ["'os.system' is not registered"]),
        (["trainer.callbacks=[]"], ["trainer.callbacks=[] is not allowed; choose callbacks by name"]),
        (["+experiment=nope"], ["Could not find 'experiment/nope'", "ablation_noBD", "refractive"]),
        (["data.root=${nope}"], ["Interpolation key 'nope' not found"]),
        (["checkpoint.every_steps=3"], ["set one of checkpoint.every_seconds and checkpoint.every_steps"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) and "=" in value[0] else "",
)
def test_mistake_on_the_command_line_gives_a_one_line_error(
    overrides: list[str], words: list[str], require_refusal: Callable[..., None]
) -> None:
    require_refusal(words, *overrides)


def test_missing_launcher_names_its_extra() -> None:
    missing = HydraException("Could not find 'hydra/launcher/ray'")
    assert in_one_line(missing) == f"{missing}; pip install 'nerfro[ray]' adds it"


def test_field_missed_by_all_rays_is_refused_before_training(
    train_here: Runner, tiny_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = "background=skybox", "background.width=8", "content.space=unbounded"
    run = [text for text in tiny_run if text not in other]
    run += ["trainer.max_steps=1", "evaluation.every=0", "background=constant", "content.space=box"]
    away = ["content.box_min=[50,50,50]", "content.box_max=[51,51,51]"]
    refused = train_here(*run, *away, f"hydra.run.dir={tmp_path / 'away'}", code=1).error
    assert "no ray of the training views meets the field's box from [50.0, 50.0, 50.0]" in refused
    assert "set content.box_min" in refused
    assert not (tmp_path / "away").exists(), "an empty folder is removed"
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    train_here(*run, *away, "hydra.run.dir=.", code=1)
    assert (tmp_path / "current").is_dir(), "but not the current one"
    small = ["content.box_min=[-0.3,-0.3,-0.3]", "content.box_max=[0.3,0.3,0.3]"]
    finished = train_here(*run, *small, f"hydra.run.dir={tmp_path / 'small'}")
    assert "% of the rays pass the field's box from [-0.3, -0.3, -0.3]" in finished.out
    whole = ["content.box_min=[-9,-9,-9]", "content.box_max=[9,9,9]"]
    assert "pass the field's box" not in train_here(*run, *whole, f"hydra.run.dir={tmp_path / 'whole'}").out


def test_straight_rays_without_an_object_need_a_box(train: Runner, tiny_scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny_scene, root)
    (root / "mesh.ply").unlink()
    own = [f"data.root={root}", "sampler/path=straight", "trainer.max_steps=1"]
    assert "content.box_min=[X,Y,Z]" in train(*own, code=1).error
    train(*own, "content.box_min=[-1,-1,-1]", "content.box_max=[1,1,1]", "evaluation.every=0")
