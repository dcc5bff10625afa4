"""`trainer.accelerator=auto` trains on the CPU, and reports a GPU that stays unused."""

import pytest
import torch

from nerfro.evaluation.request import find_device
from nerfro.training.trainer import training_accelerator


def test_auto_trains_on_the_cpu_and_says_so_where_there_is_a_gpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for there in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert training_accelerator("auto") == "cpu"
        assert capsys.readouterr().out.count("trainer.accelerator=gpu") == int(there)
        assert find_device("auto").type == "cpu"
        assert capsys.readouterr().out.count("device=cuda") == int(there)
