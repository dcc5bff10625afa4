"""Several processes that train one model learn the weights of one process, and stop and resume together."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from omegaconf import OmegaConf

from nerfro.core.types import Batch
from nerfro.registry.allowed import untyped
from nerfro.rendering import RayTracer
from nerfro.training.build import build
from nerfro.training.callbacks import Checkpoints, SharedTimer, StopOnSignal, Throughput
from nerfro.training.config import TrainConfig
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from nerfro.training.trainer import make_trainer
from tests.conftest import Runner, weights_of
from tests.processes import ONE_THREAD

# Gradients are sums in another order, so they differ in their last bits. Adam divides them by their size, and would
# make whole steps of what rounding has left of zero.
SHORT = [
    "trainer.max_steps=8",
    "checkpoint.every_steps=3",
    "checkpoint.every_seconds=null",
    "evaluation.every=4",
    "field.precision=float32",
    "optimizer.adam_epsilon=1e-8",
    "evaluation.subdivision.side=1",
    "loss.total_variation.weight=0.01",
    "+loss.distortion.weight=0.01",
]
TWO_PROCESSES = ["trainer.devices=2", "trainer.strategy=ddp"]

# Compares the processes' models in every step, which takes the second one longer, and says which step it is at.
WATCHING_LOSS = '''
"""Watches."""
import os
import signal
import time
import torch
import torch.distributed as dist
from nerfro.losses.base import Loss
from nerfro.registry.allowed import untyped
from nerfro.registry.registration import register

@register("loss", "watching")
class Watching(Loss):
    """Fails if the models of two processes differ."""

    def forward(self, renderings, batch, scene):
        time.sleep(0.05 * (1 + dist.get_rank()))
        mine = torch.cat([tensor.detach().double().flatten() for tensor in scene.state_dict().values()])
        both = [torch.empty_like(mine) for _ in range(2)]
        dist.all_gather(both, mine)
        assert torch.equal(*both), "the models of the two processes differ"
        # One write: print would write the end of the line by itself, after what the other process writes meanwhile.
        os.write(1, f"rank {dist.get_rank()} at step {batch.draws.step}\\n".encode())
        if os.environ.get("KILLED") == f"rank {dist.get_rank()} at step {batch.draws.step}":
            os.kill(os.getpid(), signal.SIGKILL)
        return renderings[-1].radiance.sum() * 0
'''


@pytest.fixture
def small(tiny_default_run: list[str]) -> list[str]:
    """Overrides of short runs that use every random draw."""
    return [*tiny_default_run, *SHORT]


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Start `python -m nerfro.train` on two processes, which compare their models; its folder is tmp_path/<name>."""
    plugins = tmp_path / "watching_plugins"
    plugins.mkdir()
    (plugins / "watching.py").write_text(WATCHING_LOSS)
    environment = os.environ | ONE_THREAD | {"NERFRO_PLUGINS": str(plugins), "TORCH_HOME": str(tmp_path / "torch")}

    def start(name: str, *overrides: str, launcher: Sequence[str] = (), **variables: str) -> subprocess.Popen[str]:
        command = [sys.executable, *launcher, "-m", "nerfro.train", *overrides, *TWO_PROCESSES]
        command += ["+loss.watching.weight=1", f"hydra.run.dir={tmp_path / name}"]
        return subprocess.Popen(
            command,
            env=environment | variables,
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


def finish(process: subprocess.Popen[str], code: int = 0) -> str:
    """What a run prints until it ends with the given exit code."""
    out, errors = process.communicate(timeout=300)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    return out


def num_rays(folder: Path) -> int:
    count: int = load_checkpoint(folder / LAST_CHECKPOINT)[0]["callbacks"]["Throughput"]["num_rays"]
    return count


def require_alike(together: Path, alone: Path) -> None:
    """Two processes have learned what one has, from as many rays."""
    expected, got = weights_of(alone), weights_of(together)
    assert expected.keys() == got.keys()
    for name in expected:
        torch.testing.assert_close(got[name], expected[name], rtol=0, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    assert num_rays(together) == pytest.approx(num_rays(alone), rel=0.2), "the other process has about as many"
    scores = [json.loads((folder / "metrics.json").read_text())["test"]["psnr"] for folder in (together, alone)]
    assert scores[0] == pytest.approx(scores[1], abs=0.05)
    command = json.loads((together / "run.json").read_text())["command"]
    assert "train_ddp_process" not in command, "the first process records the run"


@pytest.mark.slow
def test_signal_stops_both_processes_and_resumed_weights_equal_those_of_one(
    small: list[str], train_here: Runner, start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    stopped = start("two", *small)
    assert stopped.stdout is not None
    lines = []
    for line in stopped.stdout:
        lines.append(line)
        if "at step 2" in line:
            break
    stopped.send_signal(signal.SIGTERM)  # reaches the process that was started, not the one that it has started
    out = finish(stopped, code=130)
    steps = load_checkpoint(tmp_path / "two" / LAST_CHECKPOINT)[0]["global_step"]
    assert 3 <= steps <= 7, lines
    assert f"nerfro: interrupted after step {steps} and saved" in out
    out = finish(start("two", *small, "ckpt_path=last"))
    for rank in range(2):
        assert f"rank {rank} at step {steps}\n" in out
        assert f"rank {rank} at step {steps - 1}\n" not in out
    assert out.count("nerfro: refractive on") == out.count("8 steps in") == 1, "one process alone speaks"
    train_here(*small, f"hydra.run.dir={tmp_path / 'one'}")
    require_alike(tmp_path / "two", tmp_path / "one")
    assert num_rays(tmp_path / "one") > 8 * 32, "some pixels have several rays there"


@pytest.mark.slow
def test_killed_process_ends_the_other_in_one_line_and_torchrun_resumes(
    small: list[str], start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    killed = start("two", *small, KILLED="rank 1 at step 5")
    _, errors = killed.communicate(timeout=300)
    assert killed.returncode == 1, errors
    (line,) = (line for line in errors.splitlines() if "error" in line.lower())
    assert "nerfro: error: another process of this run has ended" in line
    assert "Traceback" not in errors
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node=2")
    out = finish(start("two", *small, "ckpt_path=last", launcher=torchrun))
    assert out.count("8 steps in") == 1
    assert "rank 1 at step 3\n" in out
    assert "rank 1 at step 2\n" not in out


@pytest.mark.slow
def test_time_ends_both_processes_at_one_step(
    small: list[str], start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    out = finish(start("two", *small, "trainer.max_steps=-1", "trainer.max_time=00:00:00:02"))
    steps = load_checkpoint(tmp_path / "two" / LAST_CHECKPOINT)[0]["global_step"]
    last = {rank: max(int(line.split()[-1]) for line in out.splitlines() if f"rank {rank} at" in line) for rank in "01"}
    assert last == {"0": steps - 1, "1": steps - 1}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["batches.size=33"], "batches.size=33 cannot be shared evenly by 2 processes; take a multiple of 2"),
        (["hydra.mode=MULTIRUN"], "a sweep (-m) cannot use several devices; start its runs one by one"),
    ],
)
def test_unsupported_settings_of_two_processes_are_refused_in_one_line(
    overrides: list[str], message: str, tiny_run: list[str], train_here: Runner, tmp_path: Path
) -> None:
    folders = [f"hydra.run.dir={tmp_path / 'run'}", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    finished = train_here(*tiny_run, "trainer.max_steps=2", *TWO_PROCESSES, *folders, *overrides, code=1)
    assert finished.err.splitlines()[-1].endswith(message)
    assert not list(tmp_path.rglob("config.yaml"))


def test_every_parameter_has_a_gradient_if_no_ray_meets_the_object(tiny_default_run: list[str]) -> None:
    module, data = build(overrides=[*tiny_default_run, "medium.learn_ior=true", "trainer.max_steps=1"])
    batch = RayTracer(module.renderer).trace(data.batches.draw(0))
    away = replace(batch, path=None, samples=None, rays=replace(batch.rays, directions=-batch.rays.directions))
    module.trainer, module.is_logged_step = Mock(spec=Trainer, world_size=2, global_step=0), False
    module.training_step(away, 0)["loss"].backward()
    assert [name for name, parameter in module.named_parameters() if parameter.grad is None] == []


@pytest.mark.parametrize("strategy", ["ddp", "auto"])
def test_processes_do_not_exchange_buffers(strategy: str, tmp_path: Path) -> None:
    two = {"trainer": {"devices": 2, "accelerator": "cpu", "strategy": strategy}}
    config = OmegaConf.merge(OmegaConf.structured(untyped(TrainConfig())), two)
    trainer = make_trainer(config, tmp_path, Throughput(), [])
    assert trainer.strategy._ddp_kwargs["broadcast_buffers"] is False


def test_signal_during_synchronization_is_not_lost() -> None:
    """It arrives after this process has said that there was none."""
    callback = StopOnSignal()

    def agree(decision: bool, all: bool) -> bool:
        callback._signalled = True
        return decision

    trainer: Any = Mock(spec=Trainer, strategy=Mock(reduce_boolean_decision=agree), should_stop=False, world_size=1)
    trainer.fit_loop = Mock()
    callback.stop(trainer)
    assert not callback.received
    callback.stop(trainer)
    assert callback.received
    assert trainer.should_stop


def test_processes_synchronize_a_few_times_per_second(tmp_path: Path) -> None:
    others = Mock(reduce_boolean_decision=Mock(side_effect=lambda decision, all: decision))
    others.broadcast = Mock(side_effect=lambda value: value)
    interruption, timer = StopOnSignal(), SharedTimer(timedelta(seconds=1000))
    checkpoints = Checkpoints(dirpath=tmp_path, train_time_interval=timedelta(seconds=1000))
    trainer: Any = Mock(spec=Trainer, strategy=others, should_stop=False, world_size=2, fast_dev_run=False)
    trainer.fit_loop = Mock()
    trainer.state, trainer.sanity_checking, trainer.global_step = Mock(fn="fit"), False, 1
    timer.on_train_start(trainer, Mock(spec=LightningModule))
    begun = time.perf_counter()
    for step in range(1000):
        time.sleep(2e-4)
        elapsed = timer.time_elapsed()
        for callback in (interruption, timer, checkpoints):
            callback.on_train_batch_end(trainer, Mock(spec=LightningModule), None, Mock(spec=Batch), step)
    spent = time.perf_counter() - begun
    assert others.reduce_boolean_decision.call_count + others.broadcast.call_count < 60 + 30 * spent
    assert 0 < elapsed <= spent
    # Within a second of a signal, training ends.
    interruption._signalled, begun = True, time.perf_counter()
    while not interruption.stop(trainer):
        time.sleep(2e-4)
    assert time.perf_counter() - begun < 1
    assert trainer.should_stop
