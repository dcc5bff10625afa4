"""Callbacks of Lightning that a configuration may choose by name, as in `+callbacks=learning_rate_monitor`.

Callbacks that conflict with those of every run (progress, time limit), or that need epochs, are left out.
"""

from __future__ import annotations

from typing import Literal

from lightning.pytorch import callbacks

from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import Count, Natural, Share
from nerfro.registry.registration import add, register

for _name, _cls in {
    "device_stats_monitor": callbacks.DeviceStatsMonitor,
    "early_stopping": callbacks.EarlyStopping,
    "learning_rate_monitor": callbacks.LearningRateMonitor,
}.items():
    add("callbacks", _name, _cls)


@register("callbacks", "model_checkpoint")
class ModelCheckpoint(callbacks.ModelCheckpoint):
    """Save the best checkpoints of a run after validations, beside `checkpoints/last.ckpt`, which every run has.

    Args:
        monitor: logged value that ranks the checkpoints, such as val/psnr; None saves the latest ones.
        mode: whether the smallest or the largest values are best; None for max with PSNR and SSIM, else min.
        save_top_k: number of checkpoints that are kept; -1 keeps all.
        filename: name of the files, in which {step} and {val/psnr} stand for values.
        dirpath: folder; None for `checkpoints` of the run.
    """

    def __init__(
        self,
        monitor: str | None = None,
        mode: Literal["min", "max"] | None = None,
        save_top_k: int = 1,
        filename: str = "step{step:06d}",
        dirpath: str | None = None,
    ) -> None:
        if monitor is None and save_top_k not in (-1, 0, 1):
            raise NerfroError(
                f"callbacks.model_checkpoint.save_top_k={save_top_k} needs a value that ranks the checkpoints; add "
                "callbacks.model_checkpoint.monitor=val/psnr"
            )
        if filename == "last":
            raise NerfroError(
                "callbacks.model_checkpoint.filename=last is the checkpoint of the run; take another name"
            )
        mode = mode or ("max" if monitor is not None and monitor.endswith(("psnr", "ssim")) else "min")
        super().__init__(dirpath, filename, monitor, mode=mode, save_top_k=save_top_k, auto_insert_metric_name=False)


@register("callbacks", "weight_averaging")
class WeightAveraging(callbacks.EMAWeightAveraging):
    """Average the weights over the steps; validation, scores and checkpoints have the exponential moving average.

    Args:
        decay: weight of the previous average in each update.
        every: number of steps between two updates.
        start: step of the first update.
    """

    def __init__(self, decay: Share = 0.999, every: Count = 1, start: Natural = 0) -> None:
        # Buffers, such as the density grid, are states and no weights; the average has their latest values.
        super().__init__(use_buffers=False, decay=decay, update_every_n_steps=every, update_starting_at_step=start)
