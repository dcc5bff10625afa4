"""Phases take their steps before and between training steps, and continue after an interruption."""

import copy
import time
from collections.abc import Sequence
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Timer
from torch import nn
from torch.optim import Adam

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.rendering import RayTracer, Renderer
from nerfro.training.callbacks import Throughput, steps_by_phase
from nerfro.training.phases.base import Phase, TrainingRun
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.schedule import Schedule
from tests.conftest import refused


class Counted(Phase):
    """Records its steps. It takes three before the first training step and one before every second one after it."""

    def __init__(self, record: list[tuple[str, int, int]], name: str, end: int) -> None:
        self.record, self.name, self.end = record, name, end

    def begin(self, run: TrainingRun) -> dict[str, Any]:
        self.record.append((self.name, -1, -1))
        return {"begun": len(self.record)}

    def steps_before(self, training_step: int) -> int:
        return 3 + training_step // 2

    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        self.record.append((self.name, number, state["begun"]))
        return number < self.end


def steps(schedule: Schedule, first: int, last: int, callbacks: Sequence[Callback] = ()) -> dict[str, Any]:
    """Take some training steps without a model; returns the state of the schedule."""
    module = Mock(spec=LightningModule, renderer=Mock(spec=Renderer))
    data = Mock(batches=Mock(spec=PixelBatches), tracer=Mock(spec=RayTracer))
    trainer = Mock(spec=Trainer, datamodule=data, lightning_module=module, optimizers=[Mock(spec=Adam)])
    trainer.configure_mock(global_step=first, max_steps=100, callbacks=list(callbacks))
    schedule.on_train_start(trainer, module)
    for trainer.global_step in range(first, last):
        schedule.on_train_batch_start(trainer, module, None, 0)
    return copy.deepcopy(schedule.state_dict())


def test_seconds_of_a_run_that_is_interrupted_in_a_phase_are_counted() -> None:
    throughput, trainer, module = Throughput(), Mock(spec=Trainer), Mock(spec=LightningModule)
    throughput.on_train_start(trainer, module)
    time.sleep(0.05)
    throughput.on_train_end(trainer, module)
    assert throughput.state_dict()["seconds"] >= 0.05


def test_step_without_a_result_is_refused() -> None:
    phase = Mock(spec=Phase, begin=lambda run: {}, steps_before=lambda step: 1, step=lambda run, number, state: None)
    refused(r"phase\.mine: step returned None; return True", steps, Schedule({"mine": phase}, Mock(spec=Views)), 0, 1)


def test_step_without_parameters_is_refused() -> None:
    renderer = Mock(spec=Renderer, parameters_by_name=lambda: {"background.colour": nn.Parameter(torch.zeros(()))})
    run = TrainingRun(renderer, Mock(spec=PixelBatches), Mock(spec=RayTracer), Mock(spec=Views), Mock(spec=Adam), 0.0)
    with pytest.raises(NerfroError, match=r"backgroud\.\* matches no learned .* choose from background\.colour"):
        run.parameters(["background.*", "backgroud.*"])
    refused("changes no parameter", run.descend, torch.zeros(()), run.parameters(["cameras.*"]))


@pytest.mark.parametrize("stop", [0, 2, 3])
def test_resumed_run_takes_the_phase_steps_of_an_uninterrupted_run(stop: int) -> None:
    def schedule(record: list[tuple[str, int, int]]) -> Schedule:
        return Schedule({name: Counted(record, name, end) for name, end in (("a", 9), ("b", 1))}, Mock(spec=Views))

    whole: list[tuple[str, int, int]] = []
    state = steps(schedule(whole), 0, 7)
    before = [("a", -1, -1), ("a", 0, 1), ("a", 1, 1), ("a", 2, 1), ("b", -1, -1), ("b", 0, 5), ("b", 1, 5)]
    assert whole == [*before, ("a", 3, 1), ("a", 4, 1), ("a", 5, 1)]
    assert steps_by_phase({"Schedule": state}, 7) == {"a": 6, "b": 1, "scene": 7}
    parted: list[tuple[str, int, int]] = []
    resumed = schedule(parted)
    resumed.load_state_dict(steps(schedule(parted), 0, stop))
    assert steps(resumed, stop, 7) == state
    assert parted == whole


def test_no_step_between_training_steps_begins_after_the_limit_of_time() -> None:
    record: list[tuple[str, int, int]] = []
    schedule = Schedule({"a": Counted(record, "a", 9)}, Mock(spec=Views))
    left = iter([2.0, 1.0, 0.0])
    timer = Mock(spec=Timer, time_elapsed=lambda: 10.0, time_remaining=lambda: next(left, 0.0))
    steps(schedule, 0, 0)
    state = steps(schedule, 9, 10, [timer])  # four steps are due
    assert [number for _, number, _ in record] == [-1, 0, 1, 2, 3]
    assert steps(schedule, 9, 10) != state
    assert [number for _, number, _ in record] == [-1, 0, 1, 2, 3, 4, 5, 6]


def test_step_of_a_phase_changes_only_its_parameters() -> None:
    moved, other = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
    optimizer = Adam([moved, other])
    (moved + other).sum().backward()
    optimizer.step()  # Lightning keeps the gradients until the next training step
    before = other.item()
    parts = (Mock(spec=part) for part in (Renderer, PixelBatches, RayTracer, Views))
    TrainingRun(*parts, optimizer, 0.0).descend(moved.square().sum(), [moved])
    assert other.item() == before
    assert moved.item() < before
