"""`trainer.accelerator=auto` checks and times a GPU against the CPU; the machine only pretends to have one."""

import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig
from torch import Tensor

from nerfro.fields import hash_encoding
from nerfro.kernels import available
from nerfro.kernels.constants import cached_constant
from nerfro.kernels.operators import REFERENCES
from nerfro.training import accelerator
from nerfro.training.accelerator import Compared, choose_accelerator, compare
from nerfro.training.build import Training
from nerfro.training.settings import with_values
from tests.conftest import composed
from tests.pretended_gpu import GPU, PretendedGpu
from tests.test_experiments import SMALL, shrunk

pytestmark = pytest.mark.usefixtures("unchecked")
TIMES = {"cpu": 8.0, "cuda": 2.0}


@pytest.fixture(scope="module")
def training() -> Training:
    overrides = ["+experiment=refractive", *SMALL, "data.downscale=16", "trainer.accelerator=auto"]
    return Training.start(composed(*overrides, *shrunk(composed(*overrides))))


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[PretendedGpu]:
    """A GPU whose driver has an empty cache, with steps of the times `TIMES`."""
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    for module in (available, accelerator):
        monkeypatch.setattr(module, "gpu_name", lambda device: "Pretended")
    monkeypatch.setattr(accelerator, "find_gpu", lambda: GPU)
    monkeypatch.setattr(accelerator, "milliseconds", lambda module, *_: TIMES[module.device.type])
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: False)
    cached_constant.cache_clear()
    with PretendedGpu() as pretended, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        yield pretended
    cached_constant.cache_clear()


def chosen(training: Training) -> str:
    return choose_accelerator(training.config, training.module, training.data)


def test_auto_takes_the_faster_device_and_remembers_the_comparison(
    gpu: PretendedGpu, training: Training, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:  # fmt: skip
    before = [parameter.clone() for parameter in training.module.parameters()]
    assert chosen(training) == "gpu"
    (line,) = capsys.readouterr().out.splitlines()
    assert line == "nerfro: trains on the GPU: a step takes 2 ms on Pretended and 8 ms on the CPU"
    assert all(map(torch.equal, before, training.module.parameters()))
    assert all(parameter.grad is None for parameter in training.module.parameters())
    monkeypatch.setattr(accelerator, "compare", None)  # is not called again
    assert chosen(training) == "gpu"
    assert "remembered in" in capsys.readouterr().out
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "empty"))
    monkeypatch.setattr(accelerator, "compare", lambda *_: Compared("", gpu=9.0, cpu=8.0))
    assert chosen(training) == "cpu"


@pytest.mark.parametrize("error", [3.0, float("nan")])
def test_auto_takes_the_cpu_if_the_gpu_has_other_results(
    error: float, gpu: PretendedGpu, training: Training, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def wrong(*values: Any) -> Tensor:
        return error + hash_encoding.hash_encode_in_torch(*values)

    name = next(name for name, reference in REFERENCES.items() if reference is hash_encoding.hash_encode_in_torch)
    monkeypatch.setitem(REFERENCES, name, wrong)
    assert chosen(training) == "cpu"
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("nerfro: trains on the CPU: the ")
    assert line.endswith("on Pretended")


def test_auto_takes_the_cpu_if_a_step_fails_and_tries_again_in_the_next_run(
    gpu: PretendedGpu, training: Training, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:  # fmt: skip
    def fail(*_: Any) -> None:
        raise RuntimeError("CUDA error: out of memory\nCompile with ...")

    monkeypatch.setattr(accelerator, "compare", fail)
    assert chosen(training) == "cpu"
    (line,) = capsys.readouterr().out.splitlines()
    assert line == ("nerfro: trains on the CPU: a step on Pretended fails: RuntimeError: CUDA error: out of memory")
    assert not (tmp_path / "cache").exists()


def test_auto_takes_the_cpu_for_several_processes(
    gpu: PretendedGpu, training: Training, capsys: pytest.CaptureFixture[str]
) -> None:
    several: DictConfig = with_values(training.config, {"trainer.devices": 2})
    assert choose_accelerator(several, training.module, training.data) == "cpu"
    assert "trainer.accelerator=gpu" in capsys.readouterr().out


def test_steps_are_timed_on_both_devices(
    training: Training, gpu: PretendedGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    synchronized = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: synchronized.append(1))
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: False)
    compared = compare(training.module, training.data, GPU, "32-true")
    assert not compared.difference
    assert min(compared.gpu, compared.cpu) > 0
    assert len(synchronized) >= 4


@pytest.mark.parametrize("name", ["gpu", "cuda", "mps"])
def test_missing_gpu_is_refused_before_data_are_read(
    name: str, run_here: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(available, "find_gpu", lambda: None)
    options = [f"trainer.accelerator={name}", f"hydra.run.dir={tmp_path / 'run'}"]
    error = run_here("train", *options, code=1).error
    assert error.startswith(f"nerfro: error: trainer.accelerator={name} needs a device that PyTorch")
    assert "take auto or cpu" in error


def test_run_records_the_device_that_it_trained_on(train_here: Callable[..., Any], tmp_path: Path) -> None:
    train_here("+experiment=straight", *SMALL, "trainer.accelerator=auto", f"hydra.run.dir={tmp_path}")
    assert "accelerator: cpu" in (tmp_path / "config.yaml").read_text()
    assert json.loads((tmp_path / "run.json").read_text())["gpu"] is None
