"""Training runs: from the options of `nerfro.train` to a run folder with scores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from nerfro.cli.calls import Composition
from nerfro.core.distributed import leave
from nerfro.core.progress import duration
from nerfro.core.provenance import AlgorithmSettings
from nerfro.evaluation.results import RunMetrics
from nerfro.evaluation.run_page import write_run_page
from nerfro.evaluation.scoring import ImageMetrics, announce_scoring, score_split
from nerfro.evaluation.tables import write_scores
from nerfro.kernels.available import require_accelerator, require_backend
from nerfro.rendering.scene_file import SceneFile
from nerfro.samplers.subdivision import Subdivision
from nerfro.silhouettes.mesh_match import require_match
from nerfro.training.accelerator import choose_accelerator
from nerfro.training.build import Training, check_before_training, composed_training
from nerfro.training.callbacks import StopOnSignal, Throughput, steps_by_phase
from nerfro.training.effects import warn_without_effect
from nerfro.training.run_folder import LAST_CHECKPOINT, begin, lock_run, next_steps, require_same_run
from nerfro.training.settings import with_values
from nerfro.training.trainer import finish_logs, fit, make_trainer, print_profile, quieten_lightning
from nerfro.training.viewer import Viewer
from nerfro.viewing.camera_paths import write_cameras


@dataclass(frozen=True)
class Run(os.PathLike[str]):
    """A finished training; functions that take the folder of a run, such as `nerfro.load`, also take the object.

    Attributes:
        folder: folder of the run.
        scores: scores and costs; None without evaluation.
    """

    folder: Path
    scores: RunMetrics | None = None

    def __fspath__(self) -> str:
        return str(self.folder)


def train(
    scene: SceneFile | str | Path | None = None,
    experiment: str | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    config_dir: str | Path | None = None,
) -> Run:
    """Train an experiment, and evaluate it on the test views.

    Args:
        scene: photographs and object, as `nerfro.preprocess` returns or writes them; by default, those of the
            experiment and the overrides.
        experiment: name of an experiment in conf/experiment; by default, the configuration of `python -m nerfro.train`.
        overrides: settings as on the command line, such as `["trainer.max_time=2m", "field=nerf"]`.
        out: folder of the run; by default a new folder in `outputs`.
        config_dir: folder with YAML files of your own, as `--config-dir`.

    Returns:
        The run, which `nerfro.load`, `nerfro.evaluate`, `nerfro.render` and `nerfro.export` take.

    Raises:
        NerfroError: a setting is not allowed, or the data cannot be read.
    """
    with composed_training(experiment, overrides, scene, out, config_dir) as composition:
        warn_without_effect(composition)
        return run_training(composition)


def run_training(composition: Composition) -> Run:
    """Train and evaluate a composed experiment in the folder of the run, or resume its training there."""
    AlgorithmSettings.used.clear()
    with lock_run(composition.folder, composition.config) as checkpoint:
        return Run(composition.folder, _train(composition.config, composition.folder, checkpoint))


def _train(config: DictConfig, folder: Path, checkpoint: Path | None) -> RunMetrics | None:
    """Train and evaluate; everything that can be refused is refused before training starts."""
    quieten_lightning()
    require_accelerator(config.trainer.accelerator)
    training = Training.start(config, resumes=checkpoint is not None)
    accelerator = choose_accelerator(training.config, training.module, training.data)
    config, split = with_values(training.config, {"trainer.accelerator": accelerator}), config.evaluation.split
    test = training.views if split is None else training.source.load(split).checked()
    test = test.select(range(len(test))[: config.trainer.limit_test_batches])
    metrics, renderer = ImageMetrics(), training.module.renderer
    optimizer = training.module.make_optimizer()
    num_steps = require_same_run(folder, checkpoint, config, optimizer, training.views)
    throughput, interruption, subdivision = Throughput(), StopOnSignal(), Subdivision(**config.evaluation.subdivision)
    viewers = [Viewer(config, training.source, test)] if config.viewer else []
    trainer = make_trainer(config, folder, throughput, [interruption, *viewers], num_steps)
    require_match(renderer.scene.medium, training.views)
    memory = check_before_training(renderer, training.data, trainer)
    if config.compile is not None:
        require_backend(config.compile, trainer.strategy.root_device)
    if trainer.is_global_zero:
        begin(folder, config, renderer, has_steps=not 0 <= trainer.max_steps <= num_steps)
        print(memory, flush=True)
        if split is not None:
            announce_scoring(renderer.to(trainer.strategy.root_device), test, metrics, subdivision)
    if config.compile is not None:
        renderer.scene.compile_radiance(config.compile)
    fit(trainer, training.module, training.data, checkpoint, throughput)
    trainer.save_checkpoint(folder / LAST_CHECKPOINT)
    print_profile(folder)
    leave()
    if not trainer.is_global_zero:
        return None
    if interruption.received:
        finish_logs(trainer, {})
        for viewer in viewers:
            viewer.close("The training was interrupted, and is saved.")
        print(f"nerfro: interrupted after step {trainer.global_step} and saved", flush=True)
        raise KeyboardInterrupt
    cameras = renderer.to(trainer.strategy.root_device).scene.camera
    write_cameras(folder / "cameras.json", cameras, training.views, training.source.origin)
    for callback in trainer.early_stopping_callbacks:
        if trainer.should_stop and callback.stopping_reason_message:
            print(f"stopped by early stopping at step {trainer.global_step}: {callback.stopping_reason_message}")
    states = {callback.state_key: callback.state_dict() for callback in trainer.callbacks}  # type: ignore[attr-defined]
    costs = trainer.global_step, throughput.seconds, throughput.rays_per_second
    print(f"{costs[0]} steps in {costs[1]:.0f} s, {costs[2] or 0:,.0f} rays/s")
    scores, logged, outcome = None, {}, f"Training is complete: {duration(costs[1])}."
    try:
        if split is not None:
            result, treated = score_split(renderer, test, metrics, folder, subdivision, split)
            logged = {f"{split}/{name}": mean for name, mean in result.means().items()}
            scores = RunMetrics(result, *costs, treated, steps_by_phase(states, costs[0]))
            outcome = f"{outcome[:-1]}, PSNR {result.mean('psnr'):.1f} dB on {len(test)} {split} views."
    finally:
        finish_logs(trainer, logged)
        for viewer in viewers:
            viewer.close(outcome)
    if scores is not None:
        write_scores(scores, f"{config.name} on {config.data.root}, {split} views", folder, brief=True)
    write_run_page(folder, f"{config.name} on {config.data.root}", costs[:2], throughput.curve, scores, split or "")
    print(next_steps(folder, split))
    return scores
