"""What happens around training: progress, throughput, interruption, and the record in the checkpoint."""

from __future__ import annotations

import math
import signal
import time
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from tqdm import tqdm

from nerfro.training.module import training_progress
from nerfro.types import Batch


class Throughput(Callback):
    """Counts rays and the seconds spent on training steps, over resumed runs too, and logs `train/rays_per_second`.

    Where several processes share a batch, each is taken to have as many rays as this one.

    Attributes:
        num_rays: rays trained on so far.
        seconds: wall-clock time of the training loop, without validation.
    """

    def __init__(self) -> None:
        self.num_rays, self.seconds = 0, 0.0
        self._last: float | None = None

    @property
    def rays_per_second(self) -> float | None:
        return self.num_rays / self.seconds if self.seconds > 0 else None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: Batch, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        if self._last is not None:
            self.seconds += now - self._last
        self._last = now
        self.num_rays += len(batch.rays) * trainer.world_size
        pl_module.log("train/rays_per_second", self.num_rays / self.seconds)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last = None

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._last = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        return {"num_rays": self.num_rays, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.num_rays, self.seconds = state_dict["num_rays"], state_dict["seconds"]


_FORM = "{desc} {percentage:3.0f}%|{bar}| "


class TrainingProgress(ProgressBar):
    """One line with the share of the budget (steps or time) that is spent, the ETA, rays/s and the batch's PSNR."""

    _UPDATE_SECONDS = 0.5

    def __init__(self, throughput: Throughput) -> None:
        super().__init__()
        self._throughput = throughput
        self._bar: tqdm | None = None
        self._begun = self._shown = 0.0
        self._begun_at = 0.0
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begun, self._begun_at = time.perf_counter(), training_progress(trainer)
        self._bar = tqdm(total=1.0, desc="train", bar_format=_FORM, dynamic_ncols=True, disable=not self._enabled)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        if self._bar is None or now - self._shown < self._UPDATE_SECONDS:
            return
        self._shown = now
        done = training_progress(trainer)
        rate = (done - self._begun_at) / (now - self._begun)
        eta = tqdm.format_interval((1 - done) / rate) if rate > 0 else "?"
        shown = trainer.callback_metrics
        self._bar.n = done
        # Not tqdm's postfix, which is always led by a comma.
        self._bar.bar_format = _FORM + (
            f"step {trainer.global_step} ETA {eta} {self._throughput.rays_per_second or 0:,.0f} rays/s "
            f"train PSNR {-10 * math.log10(max(float(outputs['squared_error']), 1e-10)):.2f}"
            + (f" val PSNR {float(shown['val/psnr']):.2f}" if "val/psnr" in shown else "")
        )
        self._bar.refresh()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._bar is not None:
            self._bar.n = training_progress(trainer)
            self._bar.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self._bar is not None:
            self._bar.close()


class StopOnSignal(Callback):
    """Ends training after the current step on Ctrl-C or SIGTERM, so that it can be saved whole and resumed.

    Several processes end together, whichever of them the signal reached.

    Attributes:
        received: whether that happened.
    """

    def __init__(self) -> None:
        self.received = self._signalled = False
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        def stop(number: int, frame: FrameType | None) -> None:
            self._signalled = True
            self._restore()  # a second signal ends the process at once

        try:
            self._previous = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:  # not the main thread (a launcher's worker): signals are not ours to handle
            self._previous = {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: Batch, batch_idx: int
    ) -> None:
        if trainer.strategy.reduce_boolean_decision(self._signalled, all=False):
            self.received = trainer.should_stop = True

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}


class ConfigInCheckpoint(Callback):
    """Puts the resolved configuration into every checkpoint, so that the file alone tells how to rebuild the model."""

    def __init__(self, config: str) -> None:
        self._config = config

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint["nerfro_config"] = self._config
