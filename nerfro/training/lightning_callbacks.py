"""Callbacks of Lightning that a configuration may choose by name, as in `+callbacks=learning_rate_monitor`.

Callbacks that conflict with those of every run (progress, time limit), or that need epochs, are left out. The
functions import Lightning, because the composition of a configuration does not need it, and the import takes seconds.
"""

from __future__ import annotations

from typing import Literal

from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import Count, Natural, Share
from nerfro.registry.registration import register

Mode = Literal["min", "max"]


@register("callbacks", "device_stats_monitor")
def device_stats_monitor(cpu_stats: bool | None = None) -> object:
    """Log statistics of the device, such as its memory.

    Args:
        cpu_stats: whether statistics of the CPU are logged; None if the run trains on it, which needs psutil.
    """
    from lightning.pytorch.callbacks import DeviceStatsMonitor

    return DeviceStatsMonitor(cpu_stats)


@register("callbacks", "early_stopping")
def early_stopping(
    monitor: str, min_delta: float = 0.0, patience: Natural = 3, mode: Mode | None = None, check_finite: bool = True,
    stopping_threshold: float | None = None, divergence_threshold: float | None = None,
) -> object:  # fmt: skip
    """Stop the training when a logged value stops improving.

    Args:
        monitor: logged value, such as val/psnr.
        min_delta: smallest change that counts as an improvement.
        patience: number of validations without an improvement before the training stops.
        mode: whether small or large values are good; None for max with PSNR, else min.
        check_finite: stop when the value is NaN or infinite.
        stopping_threshold: stop as soon as the value is better.
        divergence_threshold: stop as soon as the value is worse.
    """
    from lightning.pytorch.callbacks import EarlyStopping

    return EarlyStopping(
        monitor, min_delta, patience, mode=mode or _mode(monitor), check_finite=check_finite,
        stopping_threshold=stopping_threshold, divergence_threshold=divergence_threshold,
    )  # fmt: skip


@register("callbacks", "learning_rate_monitor")
def learning_rate_monitor(log_momentum: bool = False, log_weight_decay: bool = False) -> object:
    """Log the learning rate of each group of parameters.

    Args:
        log_momentum: whether the momentum is logged as well.
        log_weight_decay: whether the weight decay is logged as well.
    """
    from lightning.pytorch.callbacks import LearningRateMonitor

    return LearningRateMonitor(None, log_momentum, log_weight_decay)


@register("callbacks", "model_checkpoint")
def model_checkpoint(
    monitor: str | None = None, mode: Mode | None = None, save_top_k: int = 1,
    filename: str = "step{step:06d}", dirpath: str | None = None,
) -> object:  # fmt: skip
    """Save the best checkpoints of a run after validations, beside `checkpoints/last.ckpt`, which every run has.

    Args:
        monitor: logged value that ranks the checkpoints, such as val/psnr; None saves the latest ones.
        mode: whether the smallest or the largest values are best; None for max with PSNR, else min.
        save_top_k: number of checkpoints that are kept; -1 keeps all.
        filename: name of the files, in which {step} and {val/psnr} stand for values.
        dirpath: folder; None for `checkpoints` of the run.
    """
    from lightning.pytorch.callbacks import ModelCheckpoint

    if monitor is None and save_top_k not in (-1, 0, 1):
        raise NerfroError(
            f"callbacks.model_checkpoint.save_top_k={save_top_k} needs callbacks.model_checkpoint.monitor=val/psnr"
        )
    if filename == "last":
        raise NerfroError("callbacks.model_checkpoint.filename=last is the checkpoint of the run; take another name")
    mode = mode or _mode(monitor or "")
    return ModelCheckpoint(dirpath, filename, monitor, mode=mode, save_top_k=save_top_k, auto_insert_metric_name=False)


@register("callbacks", "weight_averaging")
def weight_averaging(decay: Share = 0.999, every: Count = 1, start: Natural = 0) -> object:
    """Average the weights over the steps; validation, scores and checkpoints have the exponential moving average.

    Args:
        decay: weight of the previous average in each update.
        every: number of steps between two updates.
        start: step of the first update.
    """
    from lightning.pytorch.callbacks import EMAWeightAveraging

    # Buffers, such as the density grid, are states and no weights; the average has their latest values.
    return EMAWeightAveraging(use_buffers=False, decay=decay, update_every_n_steps=every, update_starting_at_step=start)


def _mode(monitor: str) -> Mode:
    return "max" if monitor.endswith("psnr") else "min"
