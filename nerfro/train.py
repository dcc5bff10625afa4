"""`python -m nerfro.train`: train an experiment, evaluate it on the test views, and print the scores.

Examples:
    nerfro train trainer.max_time=2m hydra.run.dir=outputs/first
    nerfro train experiment=glass data.root=data/glass medium.mesh=data/glass/mesh.ply medium.ior=1.5
"""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.cli.failures import EXIT_INTERRUPTED
from nerfro.cli.overrides import prints_hints
from nerfro.core.distributed import leave
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import RunMetrics, optimized
from nerfro.evaluation.tables import write_scores
from nerfro.evaluation.treatments import score_split
from nerfro.fields.networks import compile_networks
from nerfro.rendering.scene_file import with_scene
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.build import build_training, check_before_training, check_command
from nerfro.training.callbacks import StopOnSignal, Throughput, steps_by_phase
from nerfro.training.config import TrainConfig, build_data, resolve_trainer_options
from nerfro.training.mesh_match import require_match
from nerfro.training.run_folder import LAST_CHECKPOINT, begin, lock_run, next_steps, require_same_run, resume_advice
from nerfro.training.sweeps import run_cell
from nerfro.training.trainer import finish_logs, fit, make_trainer, prepare_process, print_profile
from nerfro.training.viewer import Viewer
from nerfro.viewing.camera_files import write_cameras


@entry_point("train", TrainConfig, check=check_command, expand=with_scene)
def main(config: DictConfig) -> float | None:
    """Train one experiment, evaluate it, and return `optimized_metric`, which sweepers of Hydra optimize."""
    folder = Path(HydraConfig.get().runtime.output_dir)

    def train() -> RunMetrics | None:
        with lock_run(folder, config) as checkpoint:
            return _train(config, folder, checkpoint)

    metrics = run_cell(config, folder, train)
    return None if metrics is None else optimized(metrics.result, config.optimized_metric)


def _train(config: DictConfig, folder: Path, checkpoint: Path | None) -> RunMetrics | None:
    """Train and evaluate; everything that can be refused is refused before training starts."""
    prepare_process(config.seed)
    resolve_trainer_options(config)
    source = build_data(config)
    training, split = source.load("train"), config.evaluation.split
    test = training if split is None else source.load(split).checked()
    test = test.select(range(len(test))[: config.trainer.limit_test_batches])
    subdivision = Subdivision(**config.evaluation.subdivision)
    metrics = ImageMetrics()
    module, datamodule = build_training(config, source, training)
    renderer = module.renderer
    num_steps = require_same_run(folder, checkpoint, config, module.parameter_groups(), training.cameras)
    throughput, interruption = Throughput(), StopOnSignal()
    trainer = make_trainer(config, folder, throughput, [interruption, Viewer(config, source, test)], num_steps)
    device = trainer.strategy.root_device
    require_match(renderer.scene.medium, training)
    memory = check_before_training(renderer, datamodule, trainer)
    if trainer.is_global_zero:
        begin(folder, config, renderer, has_steps=not 0 <= trainer.max_steps <= num_steps)
        print(memory, flush=True)
    if config.compile is not None:
        compile_networks(renderer, config.compile)
    fit(trainer, module, datamodule, checkpoint, throughput)
    trainer.save_checkpoint(folder / LAST_CHECKPOINT)
    print_profile(folder)
    leave()
    if not trainer.is_global_zero:
        return None
    if interruption.received:
        finish_logs(trainer, {})
        advice = f"; {resume_advice(folder)}" if prints_hints() else ""
        print(f"nerfro: interrupted after step {trainer.global_step} and saved{advice}")
        sys.exit(EXIT_INTERRUPTED)

    write_cameras(folder / "cameras.json", renderer.to(device).scene.camera, training, source.origin)
    num_steps, seconds, rays_per_second = trainer.global_step, throughput.seconds, throughput.rays_per_second
    for callback in trainer.early_stopping_callbacks:
        if trainer.should_stop and callback.stopping_reason_message:
            print(f"stopped by early stopping at step {num_steps}: {callback.stopping_reason_message}")
    print(f"{num_steps} steps in {seconds:.0f} s, {rays_per_second or 0:,.0f} rays/s")
    scored, scores = None, {}
    try:
        if split is not None:
            result, treated = score_split(renderer, test, metrics, folder, subdivision, split)
            scores = {f"{split}/{name}": mean for name, mean in result.means().items()}
            states = {each.state_key: each.state_dict() for each in trainer.callbacks}  # type: ignore[attr-defined]
            phases = steps_by_phase(states, num_steps)
            scored = RunMetrics(result, num_steps, seconds, rays_per_second, treated, phases)
    finally:
        finish_logs(trainer, scores)
    if scored is not None:
        write_scores(scored, f"{config.name} on {config.data.root}, {split} views", folder, brief=True)
    print(next_steps(folder, split))
    return scored


if __name__ == "__main__":
    main()
