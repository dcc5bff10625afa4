"""`python -m nerfro.train`: train an experiment, evaluate it on the test views, and print the table."""

from __future__ import annotations

import logging
import shlex
import sys
import warnings
from datetime import timedelta
from pathlib import Path

import lightning.pytorch as pl
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import Logger, WandbLogger
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import DictConfig, OmegaConf

from nerfro.cameras import Cameras
from nerfro.cli import EXIT_INTERRUPTED, entry_point
from nerfro.distributed import leave
from nerfro.errors import NerfroError
from nerfro.evaluate import report
from nerfro.evaluation.lpips import find_lpips_networks
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling
from nerfro.evaluation.score_views import score_views
from nerfro.fields.mlp import compile_networks
from nerfro.kernels.allocator import keep_freed_memory
from nerfro.models.base import NerfModel
from nerfro.registry import build
from nerfro.samplers.training_paths import TrainingPaths
from nerfro.training.callbacks import ConfigInCheckpoint, StopOnSignal, Throughput, TrainingProgress
from nerfro.training.config import TrainConfig, build_model
from nerfro.training.data_module import RayDataModule
from nerfro.training.log import TrainingLog
from nerfro.training.ray_batches import RayBatches
from nerfro.training.run_folder import (
    LAST_CHECKPOINT,
    claim,
    find_checkpoint,
    load_checkpoint,
    record,
    require_same_configuration,
)

_SPARE_BYTES = 64 * 2**20  # pictures and logs, beside the checkpoints


@entry_point("train", TrainConfig)
def main(config: DictConfig) -> None:
    """Train one experiment and evaluate it; everything that can be refused is refused before training starts."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    checkpoint = find_checkpoint(config.ckpt_path, folder)
    if not 0 <= config.seed < 2**32:
        raise NerfroError(f"seed={config.seed} is no seed; give 0 to {2**32 - 1}")
    _quieten_lightning()
    keep_freed_memory()
    pl.seed_everything(config.seed, verbose=False)

    source = build(config.data)
    test = source.load(config.evaluation.split)
    validation = source.load("val") if config.evaluation.every > 0 and "val" in source.splits else None
    wanted, training = config.batches, source.load("train")
    batches = RayBatches(
        training,
        wanted.size,
        wanted.batching,
        config.seed,
        wanted.precrop_steps,
        wanted.precrop_fraction,
        wanted.jitter,
    )
    Supersampling(wanted.supersample, wanted.divergence)  # refuses what is out of range
    supersampling = Supersampling(config.evaluation.supersample, config.evaluation.divergence)
    lpips = find_lpips_networks(config.evaluation.lpips_backbone, config.evaluation.lpips_vgg_backbone)
    model = build_model(config)
    if checkpoint is not None:
        require_same_configuration(checkpoint, load_checkpoint(checkpoint)[1], config)
    throughput, interruption = Throughput(), StopOnSignal()
    trainer = make_trainer(config, folder, [throughput, interruption])
    batches = batches.share(trainer.global_rank, trainer.world_size)
    # Weights and Adam's two moments, in an old checkpoint that goes when the new one is whole.
    num_bytes = sum(p.numel() * p.element_size() for p in model.parameters())
    if trainer.is_global_zero:
        claim(folder, checkpoint is not None, 2 * 3 * num_bytes + _SPARE_BYTES)
        record(folder, config)
        print(f"nerfro: {config.name} on {config.data.root} -> {folder}", flush=True)
    model.training_paths = trace_training_rays(config, model, training.cameras)
    if model.training_paths is not None and model.training_paths.parts is not None:
        batches = batches.dividing(model.training_paths.parts)
    if config.compile is not None:
        compile_networks(model, config.compile)

    datamodule = RayDataModule(batches, validation, config.evaluation.every)
    trainer.fit(model, datamodule=datamodule, ckpt_path=checkpoint, weights_only=True)
    trainer.save_checkpoint(folder / LAST_CHECKPOINT)
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):  # or the next job of a sweep would go on with this one's log
            logger.experiment.finish()
    leave()
    if not trainer.is_global_zero:
        return
    if interruption.received:
        command = f"hydra.run.dir={folder} ckpt_path=last"
        print(f"nerfro: interrupted after step {trainer.global_step} and saved; to go on, repeat it with {command}")
        sys.exit(EXIT_INTERRUPTED)

    model.to(trainer.strategy.root_device)
    metrics = ImageMetrics(*lpips, prefix=config.evaluation.split)
    result = score_views(model, test, metrics, folder, supersampling)
    title = f"{config.name} on {config.data.root}, {config.evaluation.split} views"
    report(result, title, folder, trainer.global_step, throughput)
    print(f"{trainer.global_step} steps in {throughput.seconds:.0f} s, {throughput.rays_per_second or 0:,.0f} rays/s.")
    print("Look at:")
    print(f"  {folder}/images/  the pictures; metrics.json, .csv, .md and .tex beside them")
    written = shlex.quote(f"checkpoint={folder}/checkpoints/last.ckpt")
    print(f"  python -m nerfro.evaluate {written}  scores it again, or other views")
    print("  python -m nerfro.dashboard  losses and validation pictures")


def trace_training_rays(config: DictConfig, model: NerfModel, cameras: Cameras) -> TrainingPaths | None:
    """Paths of all training rays, if they stay the same and are short enough to be kept."""
    wanted = config.batches
    if not wanted.cache_paths or wanted.jitter or not model.path_sampler.few_vertices:
        return None
    return TrainingPaths.build(model.path_sampler, model.medium, cameras, wanted.supersample, wanted.divergence)


def make_trainer(config: DictConfig, folder: Path, extra: list[Callback]) -> pl.Trainer:
    """Lightning's Trainer with the callbacks that every run has.

    Raises:
        NerfroError: a field of the trainer, logger or checkpoint section is unknown or wrong.
    """
    if (config.checkpoint.every_seconds is None) == (config.checkpoint.every_steps is None):
        raise NerfroError("set one of checkpoint.every_seconds and checkpoint.every_steps, and the other to null")
    seconds, every = config.checkpoint.every_seconds, config.evaluation.every
    checkpoints = ModelCheckpoint(
        dirpath=folder / LAST_CHECKPOINT.parent,
        filename=LAST_CHECKPOINT.stem,
        every_n_train_steps=config.checkpoint.every_steps,
        train_time_interval=None if seconds is None else timedelta(seconds=seconds),
        enable_version_counter=False,
        save_on_train_epoch_end=False,
    )
    in_checkpoint = ConfigInCheckpoint(OmegaConf.to_yaml(config, resolve=True))
    ours = {
        "default_root_dir": str(folder),
        "callbacks": [checkpoints, TrainingProgress(), in_checkpoint, TrainingLog(), *extra],
        "logger": _loggers(config, folder),
        "max_epochs": -1,
        "val_check_interval": every if every > 0 else None,
        "check_val_every_n_epoch": None,
        "limit_val_batches": 1 if every > 0 else 0,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
    }
    taken = sorted(ours.keys() & config.trainer.keys())
    if taken:
        raise NerfroError(f"trainer.{taken[0]} is set by nerfro.train itself; see evaluation, checkpoint and logger")
    if config.trainer.get("strategy") == "ddp":
        # The index grid is a buffer and would be sent around in every step, though all processes have the same one.
        ours["strategy"] = DDPStrategy(broadcast_buffers=False)
    limit = config.trainer.get("max_time")
    if isinstance(limit, (int, float)):
        raise NerfroError(f"trainer.max_time={limit} has no unit; write DD:HH:MM:SS, such as 00:00:05:00")
    trainer = build(config.trainer, **ours)
    if trainer.world_size > 1 and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise NerfroError("a sweep (-m) cannot use several devices; start its runs one by one")
    if limit is None and trainer.max_steps < 0:
        raise NerfroError("the run would never end; set trainer.max_time (DD:HH:MM:SS), trainer.max_steps, or both")
    return trainer


def _loggers(config: DictConfig, folder: Path) -> list[Logger]:
    return [build(node, save_dir=str(folder)) for node in (config.logger or {}).values()]


def _quieten_lightning() -> None:
    """Keep Lightning's hints about loaders and hardware from the user: batches are made on the device here."""
    for package in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(package).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*You are using .* devices.*",
        ".*Starting from v1.9.*",
        ".*sync_dist=True.*",  # one process looks at validation views
        ".*broadcast_buffers.* is deprecated.*",  # its successor is not in all versions of torch that are supported
        ".*LeafSpec.* is deprecated.*",
    ):
        warnings.filterwarnings("ignore", message)


if __name__ == "__main__":
    main()
