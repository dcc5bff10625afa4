"""The precision of a training, and of its networks."""

import json
import math
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerfro.evaluation.request import find_device
from nerfro.fields import relu_mlp
from nerfro.fields.hash_grid import HashGridField
from nerfro.testing import example_space
from nerfro.training.trainer import lightning_precision


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "model"), [("64-true", "train"), ("bf16-mixed", "train_paper")])
def test_run_in_every_precision_ends_with_finite_scores(
    precision: str, model: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    request.getfixturevalue(model)("trainer.max_steps=2", f"trainer.precision={precision}")
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]
    assert all(math.isfinite(value) for value in scores.values() if isinstance(value, float))


def test_evaluation_on_the_cpu_reports_an_unused_gpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for there in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert find_device("auto").type == "cpu"
        assert capsys.readouterr().out.count("device=cuda") == int(there)


@pytest.fixture(params=[True, False])
def has_units(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: request.param)
    return bool(request.param)


def test_field_uses_bfloat16_if_the_machine_supports_it(has_units: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[torch.dtype] = []

    def spy(inputs: list[Tensor], weights: list[Tensor], rounds: bool) -> Tensor:
        used.append(torch.bfloat16 if rounds else torch.float32)
        return inputs[0].new_zeros(len(inputs[0]), len(weights[-1]))

    monkeypatch.setattr(relu_mlp, "relu_mlp", spy)
    positions = torch.zeros(4, 3)
    for precision in (None, "bfloat16", "float32"):
        HashGridField(example_space(), num_levels=2, log2_table_size=6, precision=precision).density(positions)
    assert used == [torch.bfloat16 if has_units else torch.float32, torch.bfloat16, torch.float32]


def test_precision_fastest_uses_bfloat16_if_the_machine_supports_it(has_units: bool) -> None:
    def named(precision: str) -> str:
        trainer: DictConfig = OmegaConf.create({"trainer": {"precision": precision, "accelerator": "cpu"}})
        return lightning_precision(trainer)

    assert named("fastest") == ("bf16-mixed" if has_units else "32-true")
    assert named("bf16-mixed") == "bf16-mixed"
    assert named("32-true") == "32-true"
