"""Callbacks of training: progress, throughput, interruption, and a warning about overfitting."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Mapping
from datetime import timedelta
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar, Timer
from lightning.pytorch.trainer.states import RunningStage
from tqdm import tqdm

from nerfro.core.progress import progress_bar
from nerfro.core.types import Batch
from nerfro.training.module import TrainingModule, training_progress


def steps_by_phase(callbacks: Mapping[str, Any], num_steps: int) -> dict[str, int]:
    """Return the number of steps in each phase of a training that took steps.

    Args:
        callbacks: states of the callbacks by name, as in a checkpoint.
        num_steps: number of training steps.
    """
    taken = {phase: begun["num_done"] for phase, begun in callbacks.get("Schedule", {}).items()}
    return {phase: count for phase, count in taken.items() if count} | {"scene": num_steps}


class Throughput(Callback):
    """Count rays and the seconds of training steps, including resumed runs, and log `train/rays_per_second`.

    All processes are assumed to have the same number of rays.

    Attributes:
        num_rays: rays trained on so far.
        seconds: wall-clock time of the training loop, without validation.
        has_begun: whether this process has begun to train, after it restored a checkpoint.
        curve: step, seconds and loss, about once a second of this process.
    """

    def __init__(self) -> None:
        self.num_rays, self.seconds, self.has_begun = 0, 0.0, False
        self.curve: list[tuple[int, float, float]] = []
        self._last: float | None = None

    @property
    def rays_per_second(self) -> float | None:
        return self.num_rays / self.seconds if self.seconds > 0 else None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last, self.has_begun = time.perf_counter(), True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        if self._last is not None:
            self.seconds += now - self._last
        self._last = now
        self.num_rays += len(batch.rays) * trainer.world_size
        pl_module.log("train/rays_per_second", self.num_rays / self.seconds)
        # On a GPU, each point waits for the step.
        if not self.curve or self.seconds - self.curve[-1][1] > 1.0:
            self.curve.append((trainer.global_step, self.seconds, float(outputs["loss"])))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._last is not None:  # a run that is interrupted in a phase has no step that counts its time
            self.seconds, self._last = self.seconds + time.perf_counter() - self._last, None

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last = None

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        return {"num_rays": self.num_rays, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.num_rays, self.seconds = state_dict["num_rays"], state_dict["seconds"]


class TrainingProgress(ProgressBar):
    """Show the progress (in steps or time), the remaining time, rays per second and PSNR."""

    def __init__(self, throughput: Throughput) -> None:
        super().__init__()
        self._throughput = throughput
        self._bar: tqdm | None = None
        self._outputs: Any = None  # of the last step
        self._shown, self._enabled = 0.0, True

    def disable(self) -> None:
        self._enabled = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._shown, begun = -math.inf, training_progress(trainer)  # the first step is shown at once
        self._bar = progress_bar("train", 1.0, initial=begun, mininterval=0.5, delay=0, disable=not self._enabled)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        self._outputs, now = outputs, time.perf_counter()
        if self._bar is None or self._bar.disable or now - self._shown < self._bar.mininterval:
            return
        self._shown = now
        self._update(self._bar, trainer)
        self._bar.refresh()

    def _update(self, bar: tqdm, trainer: Trainer) -> None:
        """Set the progress and the figures of the last step."""
        bar.n, metrics = training_progress(trainer), trainer.callback_metrics
        bar.set_postfix_str(
            f"step {trainer.global_step}, {self._throughput.rays_per_second or 0:,.0f} rays/s, "
            f"train PSNR {-10 * math.log10(max(float(self._outputs['squared_error']), 1e-10)):.2f}"
            + (f", val PSNR {float(metrics['val/psnr']):.2f}" if "val/psnr" in metrics else ""),
            refresh=False,
        )

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._bar is not None:
            if self._outputs is not None:
                self._update(self._bar, trainer)
            self._bar.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self._bar is not None:
            self._bar.close()


class Agreements:
    """Choose the steps, about half a second apart, at which several processes exchange information.

    An exchange makes each process wait for its device and for the other processes. A single process needs no exchange.
    """

    _SECONDS, _MAX_STEPS = 0.5, 1000

    def __init__(self) -> None:
        self._step = self._next = 0
        self._last: tuple[int, float] | None = None

    def due(self, trainer: Trainer) -> bool:
        """Count a step, and return whether processes exchange information; all processes get the same answer."""
        if trainer.world_size == 1:
            return True
        self._step += 1
        if self._step < self._next:
            return False
        num_steps, now = 1, time.perf_counter()
        if self._last is not None:
            step, before = self._last
            since = self._step - step
            # At most twice as many as before, because the next steps may be slower, as after a fit of the background.
            num_steps = min(int(self._SECONDS * since / max(now - before, 1e-6)), 2 * since)
        self._last = self._step, now
        wanted = self._step + min(max(num_steps, 1), self._MAX_STEPS)
        self._next = trainer.strategy.broadcast(wanted)
        return True


class SharedTimer(Timer):
    """Timer of Lightning, with one time for all processes.

    All processes use the time of the first process, because learning rates and the end of training depend on the time,
    and parameters of processes with different times would diverge.
    """

    state_key = "Timer"  # type: ignore[assignment]  # as Lightning's in checkpoints

    def __init__(self, duration: timedelta) -> None:
        super().__init__(duration)
        self._agreements = Agreements()
        self._elapsed: float | None = None  # where several processes share one

    def time_elapsed(self, stage: str = RunningStage.TRAINING) -> float:
        if stage != RunningStage.TRAINING or self._elapsed is None:
            return super().time_elapsed(stage)
        return self._elapsed

    def on_train_batch_end(self, trainer: Trainer, *args: Any, **kwargs: Any) -> None:
        if not self._agreements.due(trainer):
            return
        if trainer.world_size > 1:
            self._elapsed = trainer.strategy.broadcast(super().time_elapsed())
        super().on_train_batch_end(trainer, *args, **kwargs)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        if trainer.world_size > 1:
            self._elapsed = trainer.strategy.broadcast(super().time_elapsed())


class Checkpoints(ModelCheckpoint):
    """Checkpoints of Lightning, with a common clock for several processes."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._agreements = Agreements()

    def on_train_batch_end(self, trainer: Trainer, *args: Any, **kwargs: Any) -> None:
        if self._train_time_interval is None or self._agreements.due(trainer):
            super().on_train_batch_end(trainer, *args, **kwargs)


class StopOnSignal(Callback):
    """End training after the current step on Ctrl-C or SIGTERM, so that a complete checkpoint is saved.

    If any process receives the signal, all processes end within about half a second.

    Attributes:
        received: whether a signal has ended training.
    """

    def __init__(self) -> None:
        self.received = self._signalled = False
        self._agreements = Agreements()
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        def stop(number: int, frame: FrameType | None) -> None:
            self._signalled = True
            self._restore()  # a second signal ends the process at once

        try:
            self._previous = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:  # not the main thread (a launcher's worker): signals are not ours to handle
            self._previous = {}

    def on_train_batch_end(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        self.stop(trainer)

    def stop(self, trainer: Trainer) -> bool:
        """End training if a signal has arrived; returns whether training ends. All processes must call this method."""
        if self._agreements.due(trainer) and trainer.strategy.reduce_boolean_decision(self._signalled, all=False):
            self.received = trainer.should_stop = True
            trainer.fit_loop.epoch_loop.min_steps = None  # otherwise, Lightning continues until `min_steps`
        return self.received

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}


class OverfittingWarning(Callback):
    """Print a warning once if validation PSNR is 4 dB below training PSNR in two successive validations.

    Training PSNR is averaged over all batches since the last validation. There is no warning if cameras are refined,
    because validation views then have less accurate cameras than training views.
    """

    def __init__(self) -> None:
        # Sum of the mean squared errors of batches since the last validation, and number of batches.
        self._error, self._steps = 0.0, 0
        self._num_gaps = 0  # number of successive validations with a large difference
        self._best = -math.inf, 0  # highest validation PSNR in dB, and its step

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if isinstance(outputs, Mapping) and "squared_error" in outputs:
            self._error, self._steps = self._error + outputs["squared_error"], self._steps + 1

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        if not self._steps or "val/psnr" not in trainer.callback_metrics or pl_module.scene.camera.moves:
            return
        training = -10 * math.log10(max(float(self._error) / self._steps, 1e-10))
        self._error, self._steps = 0.0, 0
        message = self.judge(trainer.global_step, float(trainer.callback_metrics["val/psnr"]), training)
        if message is not None and trainer.is_global_zero:
            tqdm.write(f"nerfro: {message}")  # above the bar

    def judge(self, step: int, validation: float, training: float) -> str | None:
        """Return the warning after a validation, or None.

        Args:
            step: number of completed steps.
            validation, training: PSNR of validation pixels and of training pixels, dB.
        """
        self._best = max(self._best, (validation, step))
        if self._num_gaps < 2:  # otherwise the warning was printed
            # In photographs and rendered scenes, the difference is 0 to 2 dB in good runs, and 6 to 9 dB in runs with
            # floating density in front of the cameras.
            self._num_gaps = self._num_gaps + 1 if training - validation >= 4.0 else 0
            if self._num_gaps == 2:
                best, best_step = self._best
                return (
                    f"the model overfits: validation PSNR is {validation:.1f} dB after {step} steps, and was highest "
                    f"({best:.1f} dB) after {best_step}; training PSNR is {training:.1f} dB. Take more photographs, "
                    "check the poses and, for glass, surface and index (medium...); see "
                    "docs/tutorials/photographs.md, Few photographs"
                )
        return None

    def state_dict(self) -> dict[str, Any]:
        return {"num_gaps": self._num_gaps, "best": self._best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._num_gaps, self._best = state_dict["num_gaps"], state_dict["best"]
