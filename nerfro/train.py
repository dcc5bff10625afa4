"""`python -m nerfro.train`: train an experiment, evaluate it on the test views, and print the table."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import lightning.pytorch as pl
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import WandbLogger
from omegaconf import DictConfig

from nerfro.cameras import Cameras
from nerfro.cli import EXIT_INTERRUPTED, entry_point
from nerfro.distributed import leave
from nerfro.errors import NerfroError
from nerfro.evaluation.lpips import find_lpips_networks
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling
from nerfro.evaluation.score_tables import report
from nerfro.evaluation.score_views import score_views
from nerfro.fields.mlp import compile_networks
from nerfro.kernels.allocator import keep_freed_memory
from nerfro.models.base import NerfModel
from nerfro.registry import build
from nerfro.samplers.training_paths import TrainingPaths
from nerfro.training.callbacks import StopOnSignal, Throughput
from nerfro.training.config import TrainConfig, build_model
from nerfro.training.data_module import RayDataModule
from nerfro.training.ray_batches import RayBatches
from nerfro.training.run_folder import (
    LAST_CHECKPOINT,
    claim,
    find_checkpoint,
    load_checkpoint,
    record,
    require_same_configuration,
)
from nerfro.training.trainer import make_trainer, quieten_lightning

_SPARE_BYTES = 64 * 2**20  # pictures and logs, beside the checkpoints


@entry_point("train", TrainConfig)
def main(config: DictConfig) -> None:
    """Train one experiment and evaluate it; everything that can be refused is refused before training starts."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    checkpoint = find_checkpoint(config.ckpt_path, folder)
    if not 0 <= config.seed < 2**32:
        raise NerfroError(f"seed={config.seed} is no seed; give 0 to {2**32 - 1}")
    quieten_lightning()
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
    report(result, title, folder, trainer.global_step, throughput.seconds, throughput.rays_per_second)
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


if __name__ == "__main__":
    main()
