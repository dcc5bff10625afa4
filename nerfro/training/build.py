"""Construction of a training from a configuration, for `nerfro.train` and for Python programs."""

from __future__ import annotations

from collections.abc import Sequence

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from lightning.pytorch import Trainer, seed_everything
from omegaconf import DictConfig

from nerfro.cli.entry import check_configuration
from nerfro.cli.failures import in_one_line
from nerfro.cli.options import describe_command
from nerfro.cli.overrides import full_key, prints_hints
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import CONF_DIR
from nerfro.data.base import DataSource, Views
from nerfro.registry.registration import discover
from nerfro.rendering import RayTracer, Renderer
from nerfro.rendering.scene_file import with_scene
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.config import TrainConfig, build_data, build_each, build_model, check_run, resolve_trainer_options
from nerfro.training.data_module import RayDataModule
from nerfro.training.effects import settings_without_effect
from nerfro.training.memory import require_memory
from nerfro.training.module import TrainingModule
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.reach import CHECKED_RAYS, require_reach
from nerfro.training.schedule import Schedule


def build(experiment: str | None = None, overrides: Sequence[str] = ()) -> tuple[TrainingModule, RayDataModule]:
    """Build an experiment for any Trainer of Lightning.

    `lightning.Trainer(max_steps=1000).fit(module, datamodule=data)` trains it. The settings `trainer`, `logger`,
    `callbacks` and `checkpoint` have no effect. A checkpoint of the Trainer contains the configuration, so that
    `nerfro.load` and `TrainingModule.load_from_checkpoint` can read it.

    Args:
        experiment: name of an experiment in conf/experiment; by default, the configuration of `python -m nerfro.train`.
        overrides: settings as on the command line, such as `["medium.ior=1.5", "field=nerf"]`.

    Returns:
        The module, which contains the model as `module.renderer`, and the training and validation data.

    Raises:
        NerfroError: a setting is not allowed, or the data cannot be read.
    """
    discover()
    ConfigStore.instance().store(name="train_schema", node=TrainConfig, provider="nerfro")
    chosen = [] if experiment is None else [f"+experiment={experiment}"]
    given = with_scene([*chosen, *map(full_key, overrides)], ["data", "medium"])
    try:
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            config = compose("train", given)
    except HydraException as error:
        describe_command("train", TrainConfig, CONF_DIR).require_known(given)
        raise NerfroError(in_one_line(error)) from error
    check_configuration(config, TrainConfig, CONF_DIR)
    check_run(config)
    for line in settings_without_effect(config, given):
        warn(line)
    resolve_trainer_options(config)
    if config.callbacks:
        warn("nerfro.build ignores callbacks; give them to your own Trainer: lightning.Trainer(callbacks=[...])")
    seed_everything(config.seed, verbose=False)
    source = build_data(config)
    return build_training(config, source, source.load("train"))


def check_command(config: DictConfig) -> None:
    """Check the configuration of `nerfro.train`, and warn of settings of the command line that have no effect.

    Raises:
        NerfroError: the configuration cannot train.
    """
    check_run(config)
    if prints_hints():
        for line in settings_without_effect(config, HydraConfig.get().overrides.task):
            warn(line)


def build_training(config: DictConfig, source: DataSource, training: Views) -> tuple[TrainingModule, RayDataModule]:
    """Build the module and the data of a run.

    Args:
        config: configuration of the run, see `TrainConfig`; missing settings are derived from the data.
        source: data set of the run.
        training: its training views.

    Raises:
        NerfroError: medium and data set have different origins.
    """
    validation = source.load("val").checked() if config.evaluation.every > 0 and "val" in source.splits else None
    renderer = build_model(config, training)
    medium = renderer.scene.medium
    if renderer.path_sampler.needs_medium and (medium.origin != source.origin).any():
        raise NerfroError(
            f"{type(medium).__name__} has its origin at {medium.origin.tolist()}, and the data set at "
            f"{source.origin.tolist()}; a medium with an origin of its own must call its mesh file `mesh`"
        )
    data = RayDataModule(
        PixelBatches.of(training, config), validation, config.evaluation.every, config.trainer.overfit_batches,
        Subdivision(**config.batches.subdivision),
    )  # fmt: skip
    schedule = Schedule(build_each("phase", config.phase), training)
    return TrainingModule.of(renderer, config, [schedule], training.cameras), data


def check_before_training(renderer: Renderer, data: RayDataModule, trainer: Trainer) -> str:
    """Refuse a run whose rays miss the field, or that needs more memory than is free; warn of thin walls.

    Args:
        renderer: the model.
        data: data of the training.
        trainer: Trainer of this process.

    Returns:
        The estimated memory in one line.
    """
    # The pixels are not kept, because the data module moves the pixels to the training device.
    batches = data.batches_of(trainer)
    few, tracer = batches.smaller(CHECKED_RAYS), RayTracer(renderer, data.subdivision)
    first = tracer.trace(few.draw(0))
    require_reach(renderer, few, tracer, first)
    warn_of_thin_walls(renderer.path_sampler, renderer.scene.medium)
    device = trainer.strategy.root_device
    return require_memory(renderer, first, device, few.batch_size / batches.batch_size, batches.pixel_bytes)
