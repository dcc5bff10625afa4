"""Construction of a training from a configuration, for `nerfro.train` and for Python programs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import torch
from lightning.pytorch import Trainer, seed_everything
from omegaconf import DictConfig
from torch import Tensor

from nerfro.cli.calls import Composition, composed
from nerfro.cli.overrides import as_overrides
from nerfro.core.errors import NerfroError, warn
from nerfro.data.base import DataSource, Views
from nerfro.optimizers.config import matches, require_matches
from nerfro.rendering import RayTracer, Renderer
from nerfro.rendering.memory import require_memory
from nerfro.rendering.scene_file import SceneFile, with_scene
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.checks import CHECKED_RAYS, require_reach
from nerfro.training.config import (
    TrainConfig,
    build_data,
    build_each,
    build_medium,
    build_model,
    check_run,
    require_data,
    resolve_trainer_options,
)
from nerfro.training.data_module import RayDataModule
from nerfro.training.derivation import derived
from nerfro.training.effects import warn_without_effect
from nerfro.training.module import TrainingModule
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.run_folder import checkpoint_of, load_run, restore
from nerfro.training.schedule import Schedule


def build(
    experiment: str | None = None, overrides: Sequence[str] = (), config_dir: str | Path | None = None
) -> tuple[TrainingModule, RayDataModule]:
    """Build an experiment for any Trainer of Lightning.

    `lightning.Trainer(max_steps=1000).fit(module, datamodule=data)` trains it. The settings `trainer`, `logger`,
    `callbacks` and `checkpoint` have no effect. A checkpoint of the Trainer contains the configuration, so that
    `nerfro.load` and `TrainingModule.load_from_checkpoint` can read it.

    Args:
        experiment: name of an experiment in conf/experiment; by default, the configuration of `python -m nerfro.train`.
        overrides: settings as on the command line, such as `["medium.ior=1.5", "field=nerf"]`.
        config_dir: folder with YAML files of your own, such as `config_dir/experiment/mine.yaml`, as `--config-dir`.

    Returns:
        The module, which contains the model as `module.renderer`, and the training and validation data.

    Raises:
        NerfroError: a setting is not allowed, or the data cannot be read.
    """
    with composed_training(experiment, overrides, config_dir=config_dir) as composition:
        warn_without_effect(composition)
        if composition.config.callbacks:
            warn("nerfro.build ignores callbacks; give them to your own Trainer: lightning.Trainer(callbacks=[...])")
        training = Training.start(composition.config)
    return training.module, training.data


def composed_training(
    experiment: str | None,
    overrides: Sequence[str],
    scene: SceneFile | str | Path | None = None,
    out: str | Path | None = None,
    config_dir: str | Path | None = None,
) -> AbstractContextManager[Composition]:
    """Compose the configuration of a training, see `nerfro.training.run.train` and `nerfro.cli.calls.composed`."""
    arguments = [] if experiment is None else [f"+experiment={experiment}"]
    arguments += [] if scene is None or isinstance(scene, SceneFile) else as_overrides({"scene": scene})
    arguments += [*overrides, *([] if out is None else as_overrides({"hydra.run.dir": out}))]

    def expand(overrides: Sequence[str], names: Sequence[str]) -> list[str]:
        overrides = with_scene(overrides, names)
        return scene.added_to(overrides, names, "scene") if isinstance(scene, SceneFile) else overrides

    return composed("train", TrainConfig, arguments, expand, check_run, config_dir)


@dataclass(frozen=True)
class Training:
    """Data and module of a training.

    Attributes:
        source: the data set.
        views: its training views.
        config: complete configuration of the run.
        module: the module, which contains the model as `module.renderer`.
        data: batches of training pixels, and validation views.
    """

    source: DataSource
    views: Views
    config: DictConfig
    module: TrainingModule
    data: RayDataModule

    @classmethod
    def start(cls, config: DictConfig, resumes: bool = False) -> Training:
        """Set the seed, read the training views, and build the model.

        Args:
            config: configuration of the run, see `TrainConfig`; missing settings are derived from the data.
            resumes: whether a checkpoint will replace all values, so that `init_from` is not read.

        Raises:
            NerfroError: a component cannot be built, or medium and data set have different origins.
        """
        seed_everything(config.seed, verbose=False)
        config = resolve_trainer_options(config)
        require_data(config)
        source = build_data(config)
        views = source.load("train")
        return cls(source, views, *_build(config, source, views, resumes))


def _build(
    config: DictConfig, source: DataSource, training: Views, resumes: bool
) -> tuple[DictConfig, TrainingModule, RayDataModule]:
    """Build the module and the data of a run, and derive its missing settings."""
    validation = source.load("val").checked() if config.evaluation.every > 0 and "val" in source.splits else None
    medium = build_medium(config)
    config = derived(config, medium, training)
    renderer = build_model(config, medium)
    renderer.scene.begin(training.cameras)
    if config.init_from is not None and not resumes:
        print(initialize_from(renderer, config.init_from, config.init_include), flush=True)
    if renderer.path_sampler.needs_medium and (medium.origin != source.origin).any():
        raise NerfroError(
            f"{type(medium).__name__} has its origin at {medium.origin.tolist()}, and the data set at "
            f"{source.origin.tolist()}; a medium with an origin of its own must call its mesh file `mesh`"
        )
    data = RayDataModule(
        PixelBatches.of(training, config), validation, config.evaluation.every, config.trainer.overfit_batches,
        Subdivision(**config.batches.subdivision), lambda: source.load(config.evaluation.split or "test").checked(),
    )  # fmt: skip
    schedule = Schedule(build_each("phase", config.phase), training)
    return config, TrainingModule.of(renderer, config, [schedule], training), data


def check_before_training(renderer: Renderer, data: RayDataModule, trainer: Trainer) -> str:
    """Refuse a run whose rays miss the field, or that needs more memory than is free; warn of thin walls.

    Args:
        renderer: the model.
        data: data of the training.
        trainer: Trainer of this process.

    Returns:
        The estimated memory in one line.
    """
    batches = data.batches_of(trainer)
    few, tracer = batches.smaller(CHECKED_RAYS), RayTracer(renderer, data.subdivision)
    first = tracer.trace(few.draw(0))
    require_reach(renderer, few, tracer, first)
    warn_of_thin_walls(renderer.path_sampler, renderer.scene.medium)
    device = trainer.strategy.root_device
    return require_memory(renderer, first, device, few.batch_size / batches.batch_size)


def initialize_from(renderer: Renderer, run: str, include: Sequence[str]) -> str:
    """Copy parameters of another run with the same names and shapes, and the buffers of its fields and background.

    Args:
        renderer: model that receives the values.
        run: folder of the other run, or one of its checkpoints.
        include: patterns of names (`Scene.parameters_by_name`), in which an asterisk stands for any text.

    Returns:
        A line for each name that matches: loaded, skipped because the other run lacks it, or of another shape.

    Raises:
        NerfroError: the run cannot be read, a pattern matches no parameter, or nothing was loaded.
    """
    own, others = _values(renderer), _values(restore(*load_run(checkpoint_of(run))))
    require_matches("init_include", include, own)
    lines, num_loaded = [], 0
    for name, value in own.items():
        if not matches(name, include):
            continue
        other = others.get(name)
        if other is None:
            lines.append(f"  skipped {name}: {run} does not have it")
        elif other.shape != value.shape:
            lines.append(f"  skipped {name}: shape {list(value.shape)}, and {list(other.shape)} in {run}")
        else:
            with torch.no_grad():
                value.copy_(other)
            lines.append(f"  loaded {name}: shape {list(value.shape)}")
            num_loaded += 1
    if not num_loaded:
        raise NerfroError(
            f"init_from={run} has no parameter of init_include={list(include)} with the shape of this run"
        )
    return "\n".join([f"nerfro: {num_loaded} of {len(lines)} values from {run}", *lines])


def _values(renderer: Renderer) -> dict[str, Tensor]:
    """Return the parameters by name, and the stored buffers of fields and background."""
    parts = {"fields": renderer.scene.fields, "background": renderer.scene.background}
    stored = {
        f"{part}.{name}": value
        for part, module in parts.items()
        for name, value in module.state_dict(keep_vars=True).items()
    }
    return stored | renderer.parameters_by_name()
