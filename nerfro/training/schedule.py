"""The schedule of a training: when its phases take their steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

from lightning.pytorch import Callback, LightningModule, Trainer

from nerfro.core.errors import NerfroError
from nerfro.core.progress import track
from nerfro.data.base import Views
from nerfro.training.callbacks import StopOnSignal
from nerfro.training.module import TrainingModule, training_progress
from nerfro.training.phases.base import Phase, TrainingRun


class Schedule(Callback):
    """Take the steps of all phases, before the first training step and between training steps.

    Steps before the training can be interrupted, and a resumed run takes the remaining ones. No step between training
    steps begins after the limit of time.

    Args:
        phases: phases by name, in the order in which they begin.
        views: training views.
    """

    def __init__(self, phases: Mapping[str, Phase], views: Views) -> None:
        self._phases, self._views = phases, views
        # For each phase that has begun: number of steps, whether it has ended, and the state that it needs.
        self._begun: dict[str, dict[str, Any]] = {}

    def state_dict(self) -> dict[str, Any]:
        return self._begun

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._begun.update(state_dict)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step > 0:
            return
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        for name, phase in self._phases.items():
            if name not in self._begun:
                self._begun[name] = {"num_done": 0, "ended": False, "state": phase.begin(self._run(trainer))}
            total, done = phase.steps_before(0), self._begun[name]["num_done"]
            for _ in track(name, self._due(name, 0), total, initial=done):
                if any(isinstance(callback, StopOnSignal) and callback.stop(trainer) for callback in callbacks):
                    return
                self._step(name, trainer)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        for name in self._begun:
            for _ in self._due(name, trainer.global_step):
                if training_progress(trainer) >= 1:
                    return
                self._step(name, trainer)

    def _due(self, name: str, training_step: int) -> Iterator[int]:
        """Yield the numbers of the steps that a phase takes before a training step."""
        begun, phase = self._begun[name], self._phases[name]
        while not begun["ended"] and begun["num_done"] < phase.steps_before(training_step):
            yield begun["num_done"]

    def _step(self, name: str, trainer: Trainer) -> None:
        begun = self._begun[name]
        taken = self._phases[name].step(self._run(trainer), begun["num_done"], begun["state"])
        if not isinstance(taken, bool):
            raise NerfroError(f"phase.{name}: step returned {taken!r}; return True, or False to end the phase")
        if taken:
            begun["num_done"] += 1
        else:
            begun["ended"] = True

    def _run(self, trainer: Trainer) -> TrainingRun:
        renderer = cast(TrainingModule, trainer.lightning_module).renderer
        data = trainer.datamodule  # type: ignore[attr-defined]
        progress = training_progress(trainer)
        return TrainingRun(renderer, data.batches, data.tracer, self._views, trainer.optimizers[0], progress)
