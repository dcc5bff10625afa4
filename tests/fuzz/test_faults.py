"""Killed processes, full disks, and two processes in one folder."""

import errno
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock

from nerfro.evaluation.request import REQUEST_FILE
from nerfro.training.run_folder import CONFIG_FILE, LAST_CHECKPOINT, load_checkpoint
from tests import forked
from tests.fuzz.cases import rays_through_ball
from tests.fuzz.world import World

LONG = "NERFRO_LONG_CAMPAIGN" in os.environ
NUM_KILLS = 25 if LONG else 2  # of each phase of training, and of evaluation
# Settings that make a phase of training the longest.
PHASES = {
    "training": ["phase.background.steps=0"],
    "background": ["phase.background.steps=1500"],
    "cameras": ["camera=refined", "phase.cameras.start=2", "phase.cameras.every=3", "phase.background.steps=100"],
}


def tensors(node: Any) -> list[torch.Tensor]:
    if isinstance(node, torch.Tensor):
        return [node]
    children = node.values() if isinstance(node, dict) else node if isinstance(node, (list, tuple)) else ()
    return [tensor for child in children for tensor in tensors(child)]


def pictures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "images").iterdir()}


def names(folder: Path) -> list[str]:
    """Every file of a folder, hidden ones too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def written(folder: Path, name: str | Path) -> float:
    """When a file of a folder was written, in seconds."""
    return (folder / name).stat().st_mtime


def moment_of(run: Path, num_steps: int) -> str:
    """What a training that was killed was doing."""
    if not (run / LAST_CHECKPOINT).is_file():
        return "starting"
    if (run / "metrics.json").is_file():
        return "ending"
    return "training" if load_checkpoint(run / LAST_CHECKPOINT)[0]["global_step"] < num_steps else "evaluating"


def report(what: str, seconds: float, moments: Counter[str]) -> None:
    """Print where kills fell; of many, most must have fallen where there is something to lose."""
    amid = moments["training"] + moments["evaluating"]
    print(f"\n{NUM_KILLS} {what} of {seconds:.1f} s killed: {dict(moments)}, {amid} of them amid it")
    assert not LONG or amid >= 0.8 * NUM_KILLS


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES if LONG else ["cameras"])  # which has all three
def test_killed_training_resumes_to_the_same_weights(phase: str, world: World, tmp_path: Path) -> None:
    draw, num_steps = random.Random(0), 40
    options = [*world.train_options(world.root / "data"), "trainer.max_time=null", f"trainer.max_steps={num_steps}"]
    options += PHASES[phase]
    options += ["checkpoint={every_steps: 1, every_seconds: null}", "evaluation.subdivision.side=8"]
    log, right = tmp_path / "log", tmp_path / "right" / "run"
    forked.run("train", [*options, f"hydra.run.dir={tmp_path / 'compiles' / 'run'}"], log)
    forked.run("train", [*options, f"hydra.run.dir={right}"], log)
    seconds = written(right, "metrics.json") - written(right, CONFIG_FILE)
    expected, _ = load_checkpoint(right / LAST_CHECKPOINT)
    moments: Counter[str] = Counter()
    for number in range(NUM_KILLS):
        run = tmp_path / str(number) / "run"
        # One in ten is killed as it starts, the others once they have a checkpoint, or in the background's training.
        aim, within = (CONFIG_FILE, 0.2) if number % 10 == 9 else (LAST_CHECKPOINT, 0.9 * seconds)
        aim = CONFIG_FILE if phase == "background" else aim
        ran = forked.kill("train", [*options, f"hydra.run.dir={run}"], log, run / aim, draw.uniform(0, within))
        moments[moment_of(run, num_steps) if ran else "over"] += 1
        going_on = ["ckpt_path=last"] if (run / CONFIG_FILE).is_file() else []
        forked.run("train", [*options, *going_on, f"hydra.run.dir={run}"], log)
        checkpoint, _ = load_checkpoint(run / LAST_CHECKPOINT)
        for part in ("state_dict", "optimizer_states"):
            pairs = zip(tensors(expected[part]), tensors(checkpoint[part]), strict=True)
            assert all(torch.equal(one, other) for one, other in pairs), f"{part} differs after kill {number}"
        assert pictures(run) == pictures(right)
        assert names(run) == names(right)
    moments["training"] += moments.pop("starting", 0) if phase == "background" else 0
    report(f"trainings ({phase})", seconds, moments)


@pytest.mark.slow
def test_killed_evaluation_repeats_with_the_same_scores(world: World, tmp_path: Path) -> None:
    draw, log = random.Random(1), tmp_path / "log"
    options = [f"checkpoint={world.root / 'run' / LAST_CHECKPOINT}", "device=cpu", "subdivision.side=16"]
    for out in ("compiles", "right"):
        forked.run("evaluate", [*options, f"out={tmp_path / out}"], log)
    right = tmp_path / "right"
    seconds = written(right, "metrics.json") - written(right, REQUEST_FILE)
    moments: Counter[str] = Counter()
    for number in range(NUM_KILLS):
        folder = tmp_path / str(number)
        arguments = [*options, f"out={folder}"]
        ran = forked.kill("evaluate", arguments, log, folder / REQUEST_FILE, draw.uniform(0, 0.95 * seconds))
        finished = (folder / "metrics.json").is_file()
        moments["over" if not ran else "ending" if finished else "evaluating"] += 1
        forked.run("evaluate", [*arguments, *(["overwrite=true"] if finished else [])], log)
        assert pictures(folder) == pictures(right)
        assert names(folder) == names(right)
        assert (folder / "metrics.json").read_text() == (right / "metrics.json").read_text()
    report("evaluations", seconds, moments)


class Disk:
    """A disk that is full from the n-th file on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left, self._patch = 0, monkeypatch
        replace = os.replace
        monkeypatch.setattr(os, "replace", lambda *paths: (self.take(paths[0]), replace(*paths)))

    def take(self, path: object) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


# Options of each command that writes to a folder, or to a file in it; {out} stands for the folder.
COMMANDS = {
    "train": ["hydra.run.dir={out}"],
    "evaluate": ["checkpoint={run}", "out={out}", "device=cpu"],
    "render": ["checkpoint={run}", "out={out}", "device=cpu", "path=orbit", "frames=2", "resolution=8", "film=[gif]"],
    "summary": ["runs=[{run}]", "out={out}", "report=true"],
    "preprocess": ["data.root={data}", "out={out}", "resolution=16", "medium.resolution=24"],
    "calibrate": ["out={out}", "write_board=true", "board=grid", "columns=2", "rows=2"],
    "synthesize": ["scene=torus", "out={out}", "resolution=8", "spp=1"],
    "reconstruct": ["images={data}/train", "masks={data}/train", "out={out}"],
    "mask": ["data.root={out}", "outlines={{r_0: [4, 4, 12, 12]}}"],
    "export": ["checkpoint={run}", "what=sky", "out={out}/sky.png", "resolution=8"],
    "trace": ["medium.mesh={data}/mesh.ply", "medium.resolution=24", "medium.cache=false", "rays={rays}",
              "out={out}/o.npz", "plot=true"],
}  # fmt: skip


def arguments(command: str, world: World, out: Path) -> list[str]:
    """The command line of a command that writes to a folder."""
    rays = world.root / "rays.npz"
    if not rays.exists():
        np.savez(rays, **rays_through_ball())
    places = {"out": out, "run": world.root / "run", "data": world.root / "data", "rays": rays}
    given = [option.format(**places) for option in COMMANDS[command]]
    return [*world.train_options(world.root / "data"), *given] if command == "train" else given


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("export", "trace")])
def test_locked_folder_and_root_of_a_file_system_are_refused(command: str, world: World, tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"):
        for out, words in ((tmp_path, "another process is writing to"), (Path("/"), "is a whole file system")):
            ended = world.command(command, *arguments(command, world, out))
            assert ended.code == 1
            (line,) = ended.lines
            assert words in line


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "evaluate", "render", "trace", "summary", "export", "calibrate"])
def test_full_disk_at_any_file_gives_a_one_line_error(
    command: str, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, out = Disk(monkeypatch), world.root / "full"
    for number in range(100):
        disk.left = number
        found = world.trouble(command, *arguments(command, world, out), own=(out,))
        assert found is None, f"full at file {number}: {found}"
        complete = disk.left >= 0
        assert complete or not [*out.rglob("*.partial")]
        subprocess.run(["rm", "-rf", str(out)], check=True)
        if complete:
            break
    assert complete
    assert number >= 1, "something is written"


@pytest.mark.slow
def test_full_file_system_of_one_megabyte_gives_a_one_line_error(world: World, tmp_path: Path) -> None:
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
        # On a slow machine bars stand before the message.
        (line,) = [line for line in done.stderr.splitlines() if line.startswith("nerfro: ")]
        assert "free" in line or "space" in line
