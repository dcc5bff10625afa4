"""`python -m nerfro.train`: train an experiment, evaluate it on the test views, and print the table."""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfro.cli import EXIT_INTERRUPTED, entry_point
from nerfro.distributed import leave
from nerfro.evaluation.lpips import find_lpips_networks
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import RunMetrics
from nerfro.evaluation.tables import report
from nerfro.evaluation.treatments import score_split
from nerfro.fields.mlp import compile_networks
from nerfro.subdivision import Subdivision
from nerfro.training.background_pretraining import BackgroundPretraining
from nerfro.training.callbacks import StopOnSignal, Throughput
from nerfro.training.camera_steps import CameraSteps
from nerfro.training.config import TrainConfig, build_data, build_model, settle_trainer
from nerfro.training.data_module import RayDataModule, traced
from nerfro.training.memory import require_memory
from nerfro.training.module import TrainingModule
from nerfro.training.ray_batches import RayBatches
from nerfro.training.reach import require_reach
from nerfro.training.run_folder import LAST_CHECKPOINT, begin, next_steps, own, require_same_run, resume_advice
from nerfro.training.trainer import finish_logs, fit, make_trainer, prepare_process, print_profile
from nerfro.training.viewer import Viewer
from nerfro.viewing.camera_files import write_cameras


@entry_point("train", TrainConfig)
def main(config: DictConfig) -> None:
    """Train one experiment and evaluate it; everything that can be refused is refused before training starts."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    with own(folder, config) as checkpoint:
        _train(config, folder, checkpoint)


def _train(config: DictConfig, folder: Path, checkpoint: Path | None) -> None:
    prepare_process(config.seed)
    settle_trainer(config)
    source = build_data(config)
    test = source.load(config.evaluation.split).checked()
    if config.trainer.limit_test_batches is not None:
        test = test.select(range(len(test))[: config.trainer.limit_test_batches])
    validation = source.load("val").checked() if config.evaluation.every > 0 and "val" in source.splits else None
    training = source.load("train")
    batches = RayBatches.of(training, config)
    subdivision = Subdivision(**config.evaluation.subdivision)
    lpips = find_lpips_networks(config.evaluation.lpips_backbone, config.evaluation.lpips_vgg_backbone)
    renderer = build_model(config, training)
    require_same_run(folder, checkpoint, config, renderer)
    throughput, interruption = Throughput(), StopOnSignal()
    # Cameras move by sky and outlines before the sky is learned.
    cameras, boundary = CameraSteps(training), BackgroundPretraining(config.optimizer.boundary_steps, interruption)
    trainer = make_trainer(config, folder, throughput, [interruption, cameras, boundary, Viewer(config, source, test)])
    batches = traced(batches.share(trainer.global_rank, trainer.world_size), renderer, config)
    datamodule = RayDataModule(batches, validation, config.evaluation.every, config.trainer.overfit_batches)
    few = batches.smaller(4096)
    first = few.batch(0)
    require_reach(renderer, first)
    share, device = few.batch_size / batches.batch_size, trainer.strategy.root_device
    memory = require_memory(renderer, first.rays, device, share, batches.pixel_bytes)
    del batches, few  # the data module moves the pixels to the training device
    if trainer.is_global_zero:
        begin(folder, config, renderer)
        print(memory, flush=True)
    if config.compile is not None:
        compile_networks(renderer, config.compile)
    fit(trainer, TrainingModule.of(renderer, config), datamodule, checkpoint, throughput)
    trainer.save_checkpoint(folder / LAST_CHECKPOINT)
    finish_logs(trainer)
    print_profile(folder)
    leave()
    if not trainer.is_global_zero:
        return
    if interruption.received:
        print(f"nerfro: interrupted after step {trainer.global_step} and saved; {resume_advice(folder)}")
        sys.exit(EXIT_INTERRUPTED)

    write_cameras(folder / "cameras.json", renderer.to(device).scene.camera, training)
    metrics = ImageMetrics(*lpips, prefix=config.evaluation.split)
    result, treated = score_split(renderer, test, metrics, folder, subdivision, config.evaluation.refine_steps)
    title = f"{config.name} on {config.data.root}, {config.evaluation.split} views"
    spent = trainer.global_step, throughput.seconds, throughput.rays_per_second
    report(RunMetrics(result, *spent, treated), title, folder)
    print(f"{trainer.global_step} steps in {throughput.seconds:.0f} s, {throughput.rays_per_second or 0:,.0f} rays/s.")
    print(next_steps(folder))


if __name__ == "__main__":
    main()
