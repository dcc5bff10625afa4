"""Fixtures and helpers of all tests."""

import functools
import gc
import importlib
import json
import math
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from PIL import Image
from scipy.spatial.transform import Rotation

from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR

# Workers of pytest-xdist share the cores; threads that wait for each other by spinning would slow all of them down.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    # Numba reads the number of cores again for each compilation, also while a test pretends another number.
    os.environ["NUMBA_NUM_THREADS"] = str(os.cpu_count())

# A shell that starts the tests in the background has them ignore Ctrl-C, and all commands that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    gc.freeze()  # imported modules, which searches for garbage would visit again and again


def pytest_sessionfinish() -> None:
    gc.unfreeze()


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turn off the checks of annotations: for stand-ins, values that functions refuse, and code that is compiled.

    Whole commands run without the checks, too, because these take a third of their time; `tests/test_experiments.py`
    trains every experiment with the checks.
    """
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def restored_registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget the plugins that a test discovers."""
    import nerfro.registry.registration

    nerfro.registry.registration.discover()
    monkeypatch.setattr(nerfro.registry.registration, "_plugins", dict(nerfro.registry.registration._plugins))
    monkeypatch.setattr(nerfro.registry.registration, "_discovered", set(nerfro.registry.registration._discovered))
    parent = sys.modules["nerfro_plugins"]
    monkeypatch.setattr(parent, "__path__", list(parent.__path__))
    known = set(sys.modules)
    yield
    for name in set(sys.modules) - known:
        if name.startswith("nerfro_plugins."):
            del sys.modules[name]


def refused(message: str, call: Callable[..., object], /, *arguments: Any, **options: Any) -> str:
    """Require that a call raises an error of one line in which a pattern is found; returns the line."""
    with pytest.raises(NerfroError, match=message) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


class Bomb:
    """A value that runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (self.command,)


def composed(*overrides: str) -> DictConfig:
    """The configuration that `nerfro.train` composes of some overrides."""
    from nerfro.cli.options import store_schema
    from nerfro.registry.registration import discover
    from nerfro.training.config import TrainConfig

    discover()
    store_schema("train", TrainConfig)
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return compose("train", list(overrides))


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def mitsuba() -> ModuleType:
    """Mitsuba with its fastest variant; tests are skipped where only the scalar variant works, which takes minutes."""
    from nerfro.synthetic import llvm
    from nerfro.synthetic.path_tracer import load_mitsuba

    llvm.select_llvm()  # before Mitsuba is imported, which loads the library at once
    pytest.importorskip("mitsuba")
    module = load_mitsuba()
    if module.variant() == "scalar_rgb":
        pytest.skip(f"needs Mitsuba with LLVM or CUDA, but {llvm.missing_llvm()}; {llvm.HINT}")
    return module


class Finished(NamedTuple):
    """How an entry point ended: its exit code and what it printed."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line of an error; progress bars of a slow machine may stand before it."""
        lines = [line for line in self.err.splitlines() if line.strip() and not re.match(r"[\w ]+: +\d+%", line)]
        assert len(lines) == 1, self.err
        assert lines[0].startswith("nerfro: error: ")
        return lines[0]


Runner = Callable[..., Finished]  # runs a command, or one with some options, in this process


@pytest.fixture
def run_here(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Runner:
    """Run a command's main in this process to its end, as in `run_here("train", "seed=1")`.

    The command must end with the exit code `code`, by default successfully; None permits any.
    """

    def run(name: str, *overrides: str, code: int | None = 0) -> Finished:
        main = importlib.import_module(f"nerfro.{name}").main
        monkeypatch.setattr(sys, "argv", [f"nerfro.{name}", *overrides])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
        capsys.readouterr()
        ended = 0
        try:
            main()
        except SystemExit as end:
            ended = end.code if isinstance(end.code, int) else 1
        finished = Finished(ended, *capsys.readouterr())
        assert code in (ended, None), finished.out + finished.err
        return finished

    return run


@pytest.fixture
def train_here(unchecked: None, run_here: Runner) -> Runner:
    """`python -m nerfro.train` in this process."""
    return functools.partial(run_here, "train")


@pytest.fixture
def train(train_here: Runner, tiny_default_run: list[str], tmp_path: Path) -> Runner:
    """Train the default experiment on the tiny scene in tmp_path/run."""
    return functools.partial(train_here, *tiny_default_run, f"hydra.run.dir={tmp_path / 'run'}")


@pytest.fixture
def train_paper(train_here: Runner, tiny_run: list[str], tmp_path: Path) -> Runner:
    """Train the paper's components on the tiny scene in tmp_path/run."""
    return functools.partial(train_here, *tiny_run, f"hydra.run.dir={tmp_path / 'run'}")


@pytest.fixture
def evaluate_here(unchecked: None, run_here: Runner) -> Runner:
    """`python -m nerfro.evaluate` in this process, on the CPU."""
    return functools.partial(run_here, "evaluate", "device=cpu")


def train_in(folder: Path, *overrides: str) -> Path:
    """Train like `train_here`, for fixtures that several tests share; returns the folder of the run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["nerfro.train", *overrides, f"hydra.run.dir={folder}"])
        importlib.import_module("nerfro.train").main()
    return folder


def weights_of(run: Path) -> dict[str, torch.Tensor]:
    """The weights in the last checkpoint of a run."""
    from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint

    return load_checkpoint(run / LAST_CHECKPOINT)[0]["state_dict"]


UTM = (345678.0, 5234567.0, 120.0)  # typical coordinates of georeferenced data


def moved_mesh(mesh: trimesh.Trimesh, place: Sequence[float], file: Path) -> Path:
    """Write a mesh at another place, with decimals for double precision."""
    mesh = trimesh.Trimesh(mesh.vertices + place, mesh.faces, process=False)
    file.write_text(trimesh.exchange.obj.export_obj(mesh, digits=10))
    return file


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `write_tiny_scene`."""
    return write_tiny_scene(tmp_path_factory.mktemp("scenes") / "tiny_scene")


def repaint(scene: Path, root: Path, paint: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Write the cameras and the mesh of a Blender-format scene with other photographs, painted on those it has."""
    shutil.copytree(scene, root, dirs_exist_ok=True)
    for file in sorted(root.glob("*/*.png")):
        with Image.open(file) as image:
            levels = np.array(image)
        Image.fromarray(paint(levels)).save(file)
    return root


def write_tiny_scene(root: Path, scale: float = 1.0) -> Path:
    """A Blender-format folder: a ball in front of a sky that is a linear function of direction, 16x16 pixels."""
    root.mkdir()
    trimesh.creation.icosphere(2, 0.6 * scale).export(root / "mesh.ply")
    for split, num_views in (("train", 3), ("val", 2), ("test", 2)):
        (root / split).mkdir()
        frames = []
        for i in range(num_views):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler(
                "zx", [137.5 * i + 40 * num_views, 60 + 20 * i], degrees=True
            ).as_matrix()
            pose[:3, 3] = 4 * scale * pose[:3, 2]  # cameras look along -z, at the origin
            column, row = np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5)
            directions = np.stack([(column - 8) / 20, -(row - 8) / 20, -np.ones_like(row)], -1) @ pose[:3, :3].T
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
            Image.fromarray(np.uint8(np.round(255 * (0.5 + 0.4 * directions)))).save(root / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": 2 * math.atan(8 / 20), "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(document))
    return root


# Overrides of runs that end after a number of steps and log nothing.
QUIET = ["trainer.accelerator=cpu", "trainer.max_time=null", "logger=none"]


@pytest.fixture(scope="session")
def tiny_run(tiny_scene: Path) -> list[str]:
    """Overrides that make a training step take milliseconds."""
    return [
        f"data.root={tiny_scene}",
        # Named, so that these tests do not depend on what the default experiment is made of.
        "medium=voxel_grid",
        "medium.mesh=${data.root}/mesh.ply",
        "sampler/path=eikonal",
        "sampler/points=hierarchical",
        "field=nerf",
        "content.space=unbounded",
        "background=skybox",
        "sampler.path.integrator=euler",
        "loss.background.weight=0.025",
        "loss.background.ramp=0",
        "loss.smoothness.weight=1",
        "evaluation.subdivision.side=1",
        "batches.subdivision.side=1",
        "medium.resolution=32",
        "medium.smoothing_size=3",
        "medium.cache=false",
        "sampler.path.num_steps=32",
        "sampler.points.num_coarse=8",
        "sampler.points.num_fine=8",
        "batches.size=32",
        "field.width=8",
        "field.view_width=8",
        "background.width=8",
        "loss.smoothness.tile_size=4",
        *QUIET,
    ]


@pytest.fixture(scope="session")
def tiny_default_run(tiny_scene: Path) -> list[str]:
    """The overrides of `tiny_default_options` for the tiny scene."""
    return tiny_default_options(tiny_scene)


# Overrides of experiments with a hash grid and a density grid.
SMALL = [
    "medium.resolution=32",
    "medium.cache=false",
    "sampler.points.num_samples=8",
    "sampler.points.num_bins=16",
    "sampler.points.resolution=16",
    "field.num_levels=4",
    "field.log2_table_size=10",
    "field.width=16",
    "batches.size=32",
    *QUIET,
]


def tiny_default_options(scene: Path) -> list[str]:
    """Overrides that make a training step of the default experiment take milliseconds."""
    return [
        f"data.root={scene}",
        *SMALL,
        "sampler.points.update_every=3",  # the grid is updated at steps that write a checkpoint
        "background.resolutions=[4,8]",
        "loss.background={weight: 0.01, start: 2}",
        "loss.smoothness={weight: 0.1, start: 3, tile_size: 4}",
        "evaluation.subdivision.side=2",
    ]


WAITING_LOSS = '''
"""Waits."""
import time
from nerfro.losses.base import Loss
from nerfro.registry.registration import register

@register("loss", "waiting")
class Waiting(Loss):
    """Waits a little in every step, so that there is a moment to interrupt, and says which step it is at."""

    def forward(self, renderings, batch, scene):
        print(f"at step {batch.draws.step}", flush=True)
        time.sleep(0.15)
        return renderings[-1].radiance.sum() * 0
'''


@pytest.fixture
def waiting_plugins(tmp_path: Path) -> str:
    """A folder of plugins with a loss that waits."""
    (folder := tmp_path / "waiting_plugins").mkdir()
    (folder / "waiting.py").write_text(WAITING_LOSS)
    return str(folder)


@pytest.fixture(scope="session")
def trained_run(tiny_default_run: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of two steps; a test that writes to the folder copies it first."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    logged = ["logger=tensorboard", "trainer.log_every_n_steps=1"]
    return train_in(folder, *tiny_default_run, *logged, "trainer.max_steps=2", "evaluation.every=0")


@pytest.fixture
def command(run_here: Callable) -> Callable[..., str]:
    """Run `nerfro.<name>` with overrides; returns what it printed, or its one line of error."""

    def run(name: str, *overrides: str) -> str:
        finished = run_here(name, *overrides, code=None)
        return finished.error if finished.code else finished.out

    return run
