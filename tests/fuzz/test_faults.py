"""Processes that are killed, disks that are full, and two processes in one folder."""

from __future__ import annotations

import errno
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import lightning.fabric.plugins.io.torch_io as torch_io
import numpy as np
import pytest
import torch
from hypothesis import settings

from nerfro.evaluation.request import REQUEST_FILE
from nerfro.training.run_folder import CONFIG_FILE, LAST_CHECKPOINT, load_checkpoint
from tests.fuzz import kills
from tests.fuzz.world import World

LONG = settings.get_current_profile_name() == "long"
NUM_KILLS = 50 if LONG else 2  # of each command


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, tiny_scene: Path, tiny_default_run: list[str]) -> World:
    return World(tmp_path_factory.mktemp("world"), tiny_scene, tiny_default_run)


def tensors(node: Any) -> list[torch.Tensor]:
    if isinstance(node, torch.Tensor):
        return [node]
    children = node.values() if isinstance(node, dict) else node if isinstance(node, (list, tuple)) else ()
    return [tensor for child in children for tensor in tensors(child)]


def pictures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "images").iterdir()}


@pytest.mark.slow
def test_killed_training_that_goes_on_ends_with_the_same_weights(world: World, tmp_path: Path) -> None:
    draw = random.Random(0)
    options = [*world.train_options(world.root / "data"), "trainer.max_time=null", "trainer.max_steps=40"]
    options += ["checkpoint={every_steps: 1, every_seconds: null}"]
    log, right = tmp_path / "log", tmp_path / "right" / "run"
    kills.run("train", [*options, f"hydra.run.dir={right}"], log)  # compiles
    seconds = (right / "metrics.json").stat().st_mtime - (right / CONFIG_FILE).stat().st_mtime
    expected, _ = load_checkpoint(right / LAST_CHECKPOINT)
    found = {"nothing": 0, "begun": 0, "checkpoint": 0, "scored": 0}
    for number in range(NUM_KILLS):
        run = tmp_path / str(number) / "run"
        begun = run / draw.choice([".lock", CONFIG_FILE, CONFIG_FILE, CONFIG_FILE, str(LAST_CHECKPOINT)])
        kills.kill("train", [*options, f"hydra.run.dir={run}"], log, begun, draw.uniform(0, seconds))
        begun, saved = (run / CONFIG_FILE).is_file(), (run / LAST_CHECKPOINT).is_file()
        scored = (run / "metrics.json").is_file()
        found["scored" if scored else "checkpoint" if saved else "begun" if begun else "nothing"] += 1
        going_on = ["ckpt_path=last"] if begun else []
        kills.run("train", [*options, *going_on, f"hydra.run.dir={run}"], log)
        checkpoint, _ = load_checkpoint(run / LAST_CHECKPOINT)
        for part in ("state_dict", "optimizer_states"):
            pairs = zip(tensors(expected[part]), tensors(checkpoint[part]), strict=True)
            assert all(torch.equal(one, other) for one, other in pairs), f"{part} differs after kill {number}"
        assert pictures(run) == pictures(right)
    print(f"\n{NUM_KILLS} trainings of {seconds:.1f} s killed, where they were: {found}")


@pytest.mark.slow
def test_killed_evaluation_that_is_repeated_has_the_same_scores(world: World, tmp_path: Path) -> None:
    draw = random.Random(1)
    options, log = [f"checkpoint={world.root / 'run' / LAST_CHECKPOINT}", "device=cpu"], tmp_path / "log"
    kills.run("evaluate", [*options, f"out={tmp_path / 'right'}"], log)
    begun = (tmp_path / "right" / REQUEST_FILE).stat().st_mtime
    seconds = (tmp_path / "right" / "metrics.json").stat().st_mtime - begun
    num_finished = 0
    for number in range(NUM_KILLS):
        arguments = [*options, f"out={tmp_path / str(number)}"]
        kills.kill("evaluate", arguments, log, tmp_path / str(number) / REQUEST_FILE, draw.uniform(0, seconds))
        finished = (tmp_path / str(number) / "metrics.json").is_file()
        kills.run("evaluate", [*arguments, *(["overwrite=true"] if finished else [])], log)
        assert pictures(tmp_path / str(number)) == pictures(tmp_path / "right")
        files = [(folder / "metrics.json").read_text() for folder in (tmp_path / str(number), tmp_path / "right")]
        assert files[0] == files[1]
        num_finished += finished
    print(f"\n{NUM_KILLS} evaluations of {seconds:.1f} s killed, {num_finished} of them had finished")


class Disk:
    """A disk that is full from the n-th file on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left, self._patch = 0, monkeypatch
        replace, save = os.replace, torch_io._atomic_save
        monkeypatch.setattr(os, "replace", lambda *paths: (self.take(paths[0]), replace(*paths)))
        monkeypatch.setattr(torch_io, "_atomic_save", lambda what, path: (self.take(path), save(what, path)))

    def take(self, path: object) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


@pytest.mark.parametrize("command", ["train", "evaluate", "trace", "summary"])
def test_disk_that_is_full_at_any_file_is_told_in_one_line(
    command: str, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, run, out = Disk(monkeypatch), world.root / "run", world.root / "full"
    origins, directions = np.tile([[0, 0, 4.0]], (9, 1)), np.tile([[0, 0, -1.0]], (9, 1))
    np.savez(world.root / "rays.npz", origins=origins, directions=directions)
    mesh = f"medium.mesh={world.root}/data/mesh.ply"
    rays = f"rays={world.root}/rays.npz"
    arguments = {
        "train": [*world.train_options(world.root / "data"), f"hydra.run.dir={out}"],
        "evaluate": [f"checkpoint={run / LAST_CHECKPOINT}", f"out={out}", "device=cpu"],
        "trace": [mesh, "medium.resolution=24", "medium.cache=false", rays, f"out={out}/o.npz"],
        "summary": [f"runs=[{run}]", f"out={out}", "report=true"],
    }
    for number in range(100):
        disk.left = number
        found = world.trouble(command, *arguments[command], own=(out,))
        assert found is None, f"full at file {number}: {found}"
        complete = disk.left >= 0
        subprocess.run(["rm", "-rf", str(out)], check=True)
        if complete:
            break
    assert complete
    assert number >= 1, "something is written"


@pytest.mark.slow
def test_file_system_of_one_megabyte(world: World, tmp_path: Path) -> None:
    """A real one: a tmpfs that only this test's processes see."""
    place = tmp_path / "small"
    place.mkdir()
    mount = ["unshare", "-Urm", "sh", "-c", f'mount -t tmpfs -o size=1m none {place} && exec "$@"', "sh"]
    if subprocess.run([*mount, "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine lets nobody mount a tmpfs")
    ray = np.tile([[0, 0, 4.0]], (100_000, 1)) + np.random.default_rng(0).normal(size=(100_000, 3)) / 9
    np.savez(tmp_path / "rays.npz", origins=ray, directions=np.tile([[0, 0, -1.0]], (100_000, 1)))
    mesh = [f"medium.mesh={world.root}/data/mesh.ply", "medium.resolution=24", "medium.cache=false"]
    commands: dict[str, list[str]] = {
        "train": [*world.train_options(world.root / "data"), f"hydra.run.dir={place}/run"],
        "trace": [*mesh, f"rays={tmp_path}/rays.npz", f"out={place}/o.npz"],
    }
    for name, arguments in commands.items():
        done = subprocess.run(
            [*mount, sys.executable, "-m", f"nerfro.{name}", *arguments], capture_output=True, text=True, cwd=tmp_path
        )
        assert done.returncode == 1, done.stderr
        (line,) = done.stderr.strip().splitlines()
        assert "free" in line or "space" in line
