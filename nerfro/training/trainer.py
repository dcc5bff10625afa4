"""Construction of the Trainer of Lightning for a run."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.loggers import CSVLogger, WandbLogger
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import DictConfig

from nerfro.core.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.kernels.available import fast_bfloat16, keep_freed_memory
from nerfro.registry.registration import build, create, find
from nerfro.training.callbacks import Checkpoints, OverfittingWarning, SharedTimer, Throughput, TrainingProgress
from nerfro.training.config import training_device
from nerfro.training.data_module import validation_interval
from nerfro.training.log import TrainingLog, keep_rows
from nerfro.training.run_folder import CONFIG_FILE, LAST_CHECKPOINT, in_sweep

# Arguments of the Trainer with an implementation in nerfro.
_OWN = ("profiler", "fast_dev_run", "overfit_batches", "limit_test_batches")
_ONE_PROCESS = [(1, 1), (1, "1"), (1, "auto")]  # numbers of nodes and devices
_LOST_CONNECTION = re.compile("gloo|NCCL|[Cc]onnection (closed|reset)")  # in errors of torch.distributed
_PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}


def make_trainer(
    config: DictConfig, folder: Path, throughput: Throughput, extra: list[Callback], num_steps: int = 0
) -> pl.Trainer:
    """Create the Trainer of a run with its callbacks and loggers.

    Args:
        config: configuration of the run, see `TrainConfig`; its `trainer.accelerator` is not `auto`.
        folder: folder of the run.
        throughput: counter of rays and seconds.
        extra: further callbacks.
        num_steps: number of steps of the checkpoint from which the run resumes.
    """
    seconds, every, profiler = config.checkpoint.every_seconds, config.evaluation.every, config.trainer.profiler
    checkpoints = Checkpoints(
        dirpath=folder / LAST_CHECKPOINT.parent,
        filename=LAST_CHECKPOINT.stem,
        every_n_train_steps=config.checkpoint.every_steps,
        train_time_interval=None if seconds is None else timedelta(seconds=seconds),
        enable_version_counter=False,
        save_on_train_epoch_end=False,
    )
    callbacks = [create(find("callbacks", str(name)), node or {}) for name, node in config.callbacks.items()]
    for callback in callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
            callback.dirpath = str(folder / LAST_CHECKPOINT.parent)
    ours: dict[str, Any] = {
        "default_root_dir": str(folder),
        "profiler": None if profiler is None else _PROFILERS[profiler](dirpath=folder / "profile", filename=profiler),
        "callbacks": [
            *([checkpoints] if config.trainer.enable_checkpointing else []),
            throughput,
            *([TrainingProgress(throughput)] if config.trainer.enable_progress_bar else []),
            *callbacks,
            TrainingLog(config),
            OverfittingWarning(),
            *extra,
        ],
        "plugins": [CheckpointFiles()],
        "logger": [build(node, save_dir=str(folder)) for node in (config.logger or {}).values()],
        "max_epochs": -1,
        "min_epochs": 0,  # with `min_steps`, Lightning would wait for the end of an epoch, which no training has
        "val_check_interval": validation_interval(every) or None,
        "check_val_every_n_epoch": None,
        "limit_val_batches": 1 if every > 0 else 0,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
        "precision": lightning_precision(config),
    }
    if config.trainer.strategy == "ddp" or (config.trainer.strategy == "auto" and not one_process(config)):
        # Buffers, such as the index grid, are equal in all processes and need no broadcast in every step.
        ours["strategy"] = DDPStrategy(broadcast_buffers=False, find_unused_parameters=False)
    options = {name: value for name, value in config.trainer.items() if value is not None and name not in _OWN}
    trainer = build(options, **ours)
    for logger in trainer.loggers:
        if isinstance(logger, CSVLogger) and trainer.is_global_zero:
            keep_rows(logger, num_steps)
    trainer.callbacks = [_shared(callback) for callback in trainer.callbacks]
    if trainer.world_size > 1 and in_sweep():
        raise NerfroError("a sweep (-m) cannot use several devices; start its runs one by one")
    if trainer.world_size > 1 and config.ckpt_path == "last" and not (folder / CONFIG_FILE).is_file():
        raise NerfroError("several processes could disagree about the last run; name its file in ckpt_path")
    return trainer


def print_profile(folder: Path) -> None:
    """Print the reports in the run folder of a profiled training."""
    for report in sorted((folder / "profile").glob("*.txt")):
        print(report.read_text(encoding="utf-8"))


def _shared(callback: Callback) -> Callback:
    """Replace Lightning's timer of `max_time` by a timer that all processes share."""
    if type(callback) is not Timer:
        return callback
    remaining = callback.time_remaining()
    assert remaining is not None
    return SharedTimer(timedelta(seconds=remaining))


def one_process(config: DictConfig) -> bool:
    """Return whether a run has one process."""
    return (config.trainer.num_nodes or 1, config.trainer.devices) in _ONE_PROCESS


def lightning_precision(config: DictConfig) -> str:
    """Convert `trainer.precision` to the name in Lightning."""
    precision: str = config.trainer.precision
    if precision != "fastest":
        return precision
    return "bf16-mixed" if fast_bfloat16(training_device(config)) else "32-true"


def fit(
    trainer: pl.Trainer,
    module: pl.LightningModule,
    data: pl.LightningDataModule,
    checkpoint: Path | None,
    throughput: Throughput,
) -> None:
    """Train from the start, or resume a checkpoint.

    Raises:
        NerfroError: the state of the trainer in the checkpoint cannot be restored, or another process has ended.
    """
    keep_freed_memory()  # of training, but not of tables that were built before
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except Exception as error:  # Lightning and its callbacks raise many kinds of errors on a damaged state
        if trainer.world_size > 1 and _LOST_CONNECTION.search(str(error)):
            reason = "another process of this run has ended; see its messages"
            raise NerfroError(f"{reason}, and resume with ckpt_path=last") from error
        if checkpoint is None or throughput.has_begun:
            raise
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise NerfroError(f"{checkpoint} cannot be resumed ({reason}); start without ckpt_path") from error


def finish_logs(trainer: pl.Trainer, scores: Mapping[str, float | None]) -> None:
    """Log the final scores, and close the logs, because otherwise the next job of a sweep appends to them."""
    finite = {name: score for name, score in scores.items() if score is not None}
    for logger in trainer.loggers:
        if finite:
            logger.log_metrics(finite, trainer.global_step)
        logger.finalize("success")
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def quieten_lightning() -> None:
    """Suppress Lightning's hints about data loaders and hardware, which do not apply here."""
    for package in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(package).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*You are using .* devices.*",
        ".*Starting from v1.9.*",
        ".*Total length of .* across ranks is zero.*",  # of data sets without validation views
        ".*sync_dist=True.*",  # only one process evaluates validation views
        ".*broadcast_buffers.* is deprecated.*",  # the replacement is missing in older supported versions of torch
        ".*LeafSpec.* is deprecated.*",
        # Resumed runs, in their own folder or in another one.
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*The dirpath has changed from .*",
        ".*Experiment logs directory .* exists and is not empty.*",  # `keep_rows` keeps the rows
    ):
        warnings.filterwarnings("ignore", message)


class CheckpointFiles(TorchCheckpointIO):
    """Write checkpoints of Lightning atomically: the old checkpoint stays until the new one is complete.

    Lightning writes to the temporary folder of the system. If the folder is on another disk, the file is copied over
    the old checkpoint, and a process that is killed during the copy leaves no checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        with atomic_file(path) as stream:
            try:
                torch.save(checkpoint, stream)
            except RuntimeError as error:
                if isinstance(error.__context__, OSError):  # such as a full disk, which PyTorch hides
                    raise error.__context__ from None
                raise
