"""Configuration of a training run, and construction of the model from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR, resolve_path, scene_name
from nerfro.core.progress import clock_time
from nerfro.data.base import DataSource, WithValidationViews
from nerfro.evaluation.results import Region
from nerfro.geometry.space import corners_of_box
from nerfro.kernels.available import find_gpu, require_accelerator
from nerfro.media.base import Medium, Vacuum
from nerfro.media.body_settings import origin_of
from nerfro.optimizers.config import OptimizerConfig
from nerfro.registry.allowed import (
    Count,
    Names,
    Natural,
    NotNegative,
    NumRays,
    OnlyWith,
    Positive,
    Refused,
    Resolution,
    plain,
    untyped,
    validate,
)
from nerfro.registry.registration import (
    build,
    check_node,
    configure,
    create,
    find,
    plugin_of,
    plugins,
    require_lightning,
)
from nerfro.rendering import Components, Renderer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.content import ContentConfig, require_box, space_of
from nerfro.training.settings import with_values

MetricName = Annotated[str, Names(lambda: [plugin.name for plugin in plugins("metric")])]  # of a region: mask.NAME


@dataclass
class SamplerConfig:
    """Path sampler and point sampler.

    Attributes:
        path: plugin of type `sampler/path`.
        points: plugin of type `sampler/points`.
    """

    path: Any = MISSING
    points: Any = MISSING


@dataclass
class BatchesConfig:
    """Selection of the training pixels.

    Attributes:
        size: number of pixels in a step.
        batching: whether the pixels of a step come from one image or from all images.
        object_fraction: fraction of the pixels of a step that is drawn only from the object, according to the
            masks.
        num_validation_views: number of training views, spread over the positions of the cameras, that are used
            for validation instead.
        precrop_steps: number of first steps that see only the central window of the images.
        precrop_fraction: relative side of the window.
        subdivision: which pixels get several rays, in training and in validation.
    """

    size: NumRays = 2048
    batching: Literal["single_image", "all_images"] = "all_images"
    object_fraction: Annotated[float, Ge(0), Le(1)] = 0.0
    num_validation_views: Natural = 0
    precrop_steps: Natural = 0
    precrop_fraction: Annotated[float, Gt(0), Le(1), OnlyWith("precrop_steps")] = 0.5
    subdivision: Subdivision = dataclasses.field(default_factory=lambda: Subdivision(2, 8.0, 0.1, 400))


@dataclass
class EvaluationConfig:
    """Evaluation of the trained model.

    Attributes:
        split: split of the data set; None, and `evaluation=none`, end the run without scores.
        chunk_size: rays rendered in one chunk; bounds the memory.
        every: steps between two images of validation views during training; the PSNR of a subset of their
            pixels is computed five times as often. 0 switches validation off.
        subdivision: which pixels get several rays.
    """

    split: str | None = "test"
    chunk_size: NumRays = 8192
    every: Natural = 500
    subdivision: Subdivision = dataclasses.field(default_factory=lambda: Subdivision(4, 1.5, 0.1))


@dataclass
class CheckpointConfig:
    """Interval between checkpoints: in seconds or in steps. Only the latest checkpoint is kept.

    Attributes:
        every_seconds: seconds between two checkpoints.
        every_steps: training steps between two checkpoints.
    """

    every_seconds: Annotated[float, Gt(0), Le(10**9)] | None = 60.0
    every_steps: Count | None = None


_EPOCHS = "a run has no epochs; set trainer.max_steps, trainer.max_time or evaluation.every"


@dataclass
class TrainerConfig:
    """Arguments of Lightning's Trainer; those that nerfro sets itself are refused. None is Lightning's default.

    Attributes:
        accelerator: auto trains on a GPU if its first steps agree with the CPU and take less time, else on the CPU;
            gpu insists on a GPU.
        max_steps: -1 trains until max_time.
        max_time: such as 90s, 5m, 1.5h, 2d, or DD:HH:MM:SS.
        precision: `fastest` selects bf16-mixed if the machine has bfloat16 units, else 32-true.
        profiler: time of each part of a step, on the console and in profile/ of the run folder.
        enable_checkpointing: without checkpoints during training, an interrupted run still writes one at its
            end.
        overfit_batches: train on this number of batches, repeated; 0 draws new pixels in every step.
        limit_test_batches: number of scored views; None scores all.
        fast_dev_run: train for this number of steps, or for one step if true, and score one view.
    """

    _target_: str = "lightning.pytorch.Trainer"
    accelerator: Literal["auto", "cpu", "gpu", "cuda", "mps"] = "auto"
    devices: Any = 1
    num_nodes: Count | None = None
    strategy: Any = "auto"
    max_steps: Annotated[int, Ge(-1), Le(10**9)] = -1
    max_time: Any = None
    precision: Literal["32-true", "fastest", "16-mixed", "bf16-mixed", "64-true"] = "32-true"
    gradient_clip_val: Positive | None = None
    gradient_clip_algorithm: Annotated[Literal["norm", "value"] | None, OnlyWith("gradient_clip_val")] = None
    log_every_n_steps: Count = 50
    deterministic: Literal[True, False, "warn"] | None = None
    benchmark: bool | None = None
    detect_anomaly: bool | None = None
    profiler: Literal["simple", "advanced", "pytorch"] | None = None
    enable_model_summary: bool = False
    enable_progress_bar: bool = True
    enable_checkpointing: bool = True
    min_steps: Count | None = None
    overfit_batches: Natural = 0
    limit_test_batches: Count | None = None
    inference_mode: bool | None = None
    fast_dev_run: Natural | bool = False
    accumulate_grad_batches: Annotated[Any, Refused("batches depend on the step; set batches.size")] = None
    barebones: Annotated[Any, Refused("set logger=none trainer.enable_checkpointing=false")] = None
    callbacks: Annotated[Any, Refused("choose callbacks by name, as in +callbacks=learning_rate_monitor")] = None
    check_val_every_n_epoch: Annotated[Any, Refused(_EPOCHS)] = None
    default_root_dir: Annotated[Any, Refused("set hydra.run.dir")] = None
    enable_autolog_hparams: Annotated[Any, Refused("the settings of a run are always written")] = None
    limit_predict_batches: Annotated[Any, Refused("training predicts nothing; see python -m nerfro.render")] = None
    limit_train_batches: Annotated[Any, Refused(f"{_EPOCHS}, or trainer.overfit_batches to repeat batches")] = None
    limit_val_batches: Annotated[Any, Refused("set evaluation.every=0 to switch validation off")] = None
    logger: Annotated[Any, Refused("choose loggers by name, as in logger=wandb")] = None
    max_epochs: Annotated[Any, Refused(_EPOCHS)] = None
    min_epochs: Annotated[Any, Refused(_EPOCHS)] = None
    model_registry: Annotated[Any, Refused("checkpoints are written to the run folder")] = None
    num_sanity_val_steps: Annotated[Any, Refused("validation is tried in the first steps; set evaluation.every")] = None
    plugins: Annotated[Any, Refused("plugins of nerfro have their own registry; see docs/guides/plugins.md")] = None
    reload_dataloaders_every_n_epochs: Annotated[Any, Refused(_EPOCHS)] = None
    sync_batchnorm: Annotated[Any, Refused("no model has batch normalization")] = None
    use_distributed_sampler: Annotated[Any, Refused("every process draws its own share of the pixels")] = None
    val_check_interval: Annotated[Any, Refused("set evaluation.every")] = None


@dataclass
class AuthorsConfig:
    """Settings of the authors of the paper for a scene, used by `paper_*` and `ablation_euler`.

    Attributes:
        box_min: lower corner of the index grid, world units.
        box_max: upper corner of the index grid, world units.
        resolution: vertices of the index grid along each side.
        smoothing_size: taps of the smoothing kernel.
        smoothing_sigma: standard deviation of the smoothing kernel, voxels.
        num_steps: number of Eikonal steps, N_c x N_e.
        background_weight: weight of the background regularizer.
        max_steps: number of training steps.
    """

    box_min: list[float] = dataclasses.field(default_factory=lambda: [-1.5] * 3)
    box_max: list[float] = dataclasses.field(default_factory=lambda: [1.5] * 3)
    resolution: Resolution = 512
    smoothing_size: Natural = 9
    smoothing_sigma: Positive = 1.0
    num_steps: Count = 768
    background_weight: NotNegative = 0.025
    max_steps: Count = 200_000


@dataclass
class TrainConfig:
    """Root of the configuration of `python -m nerfro.train`, composed from conf/train.yaml.

    Attributes:
        name: name of the experiment and of the run folder.
        seed: seed of the initialization and of all random numbers.
        data, camera, medium, field, background, model: a plugin of each type.
        sampler: path sampler and point sampler.
        loss: settings of each training loss, by the registered name of the loss.
        phase: settings of each phase, by the registered name of the phase.
        logger: Lightning loggers, by any name.
        callbacks: settings of each callback, by the registered name of the callback.
        optimized_metric: score that training returns to sweepers of Hydra: a metric, or `<region>.<metric>`,
            such as mask.psnr.
        debug: a run of ten steps that scores one view.
        ckpt_path: checkpoint to resume from, or `last` for the newest checkpoint of this experiment.
        init_from: folder of another run, or one of its checkpoints, whose parameters are the initial values.
        init_include: patterns of the names of these parameters, such as background.*.
        viewer: serve an interactive page of the model during training, to browsers on this machine.
        viewer_port: port of the page; 0 selects a free port.
        compile: backend of torch.compile for the fields and the background, such as inductor on a GPU; None does
            not compile them. Compilation takes half a minute or more at the start.
    """

    name: str = "refractive"
    seed: Annotated[int, Ge(0), Le(2**32 - 1)] = 0
    data: Any = MISSING
    camera: Any = MISSING
    medium: Any = MISSING
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)
    field: Any = MISSING
    background: Any = MISSING
    model: Any = MISSING
    loss: dict[str, Any] = dataclasses.field(default_factory=dict)
    phase: dict[str, Any] = dataclasses.field(default_factory=dict)
    content: ContentConfig = dataclasses.field(default_factory=ContentConfig)
    authors: AuthorsConfig = dataclasses.field(default_factory=AuthorsConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    batches: BatchesConfig = dataclasses.field(default_factory=BatchesConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    trainer: TrainerConfig = dataclasses.field(default_factory=TrainerConfig)
    logger: Any = None
    callbacks: dict[str, Any] = dataclasses.field(default_factory=dict)
    optimized_metric: MetricName = "psnr"
    debug: bool = False
    ckpt_path: str | None = None
    init_from: str | None = None
    init_include: Annotated[list[str], OnlyWith("init_from")] = dataclasses.field(default_factory=lambda: ["*"])
    viewer: bool = False
    viewer_port: Annotated[int, Ge(0), Le(65535)] = 8008
    compile: str | None = None


def check_trained(config: DictConfig, origin: Path) -> DictConfig:
    """Check the configuration of a trained run, which may come from somebody else, and add missing defaults.

    Args:
        config: configuration from a checkpoint or run folder.
        origin: file that the configuration was read from, for messages.

    Raises:
        NerfroError: a name or a value does not fit `TrainConfig`.
    """
    try:
        typed = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(untyped(TrainConfig())), config))
        if OmegaConf.select(config, "optimizer.groups") is not None:
            # The run may lack groups of the defaults.
            OmegaConf.update(typed, "optimizer.groups", config.optimizer.groups, merge=False)
        validate(TrainConfig, plain(typed), complete=False)
        content = typed.content
        if content.box_min is not None or content.box_max is not None:
            corners_of_box(content.box_min or [], content.box_max or [])
    except (OmegaConfBaseException, OverflowError, NerfroError) as error:
        reason = " ".join(str(error).split())
        raise NerfroError(f"{origin} has a configuration that nerfro.train does not write: {reason}") from error
    return typed


def check_run(config: DictConfig) -> None:
    """Refuse a configuration that cannot train, as far as this is known without its data.

    Raises:
        NerfroError: a setting has no meaning or contradicts another one, or does not fit its plugin.
    """
    OmegaConf.to_container(config.data, resolve=True)  # an interpolation without a value is an error
    limit = clock_time(config.trainer.max_time)
    if (config.checkpoint.every_seconds is None) == (config.checkpoint.every_steps is None):
        raise NerfroError("set one of checkpoint.every_seconds and checkpoint.every_steps, and the other to null")
    for node in (config.trainer, *(config.logger or {}).values()):
        require_lightning(node)
    region, _, metric = config.optimized_metric.rpartition(".")
    find("metric", metric)
    if region not in ("", *get_args(Region)):
        raise NerfroError(
            f"optimized_metric={config.optimized_metric} is not a score; write METRIC, mask.METRIC or crop.METRIC"
        )
    for name, node in config.callbacks.items():
        configure(find("callbacks", str(name)), node or {})
    for plugin_type in ("loss", "phase"):
        build_each(plugin_type, config[plugin_type])
    require_box(config)
    for node in (config.data, config.camera, config.sampler.points, config.field, config.background, config.model):
        check_node(node)
    if check_node(config.sampler.path).needs_medium:  # type: ignore[attr-defined]
        check_node(config.medium)
    if config.background.get("image") and config.model.get("colour") == "srgb":
        raise NerfroError(
            "background.image holds linear radiance, but fields and background have sRGB values with "
            "model.colour=srgb; take model.colour=linear"
        )
    if limit is None and config.trainer.max_steps < 0 and not (config.debug or config.trainer.fast_dev_run):
        raise NerfroError("the run would never end; set trainer.max_time, such as 5m, trainer.max_steps, or both")


def resolve_trainer_options(config: DictConfig) -> DictConfig:
    """Convert `max_time`, and shorten the run to a few steps and one scored view for `debug` or `fast_dev_run`."""
    values: dict[str, Any] = {"trainer.max_time": clock_time(config.trainer.max_time)}
    fast = config.trainer.fast_dev_run
    if config.debug or fast:
        steps = 10 if config.debug else int(fast)
        values |= {"trainer.max_steps": steps, "trainer.limit_test_batches": 1}
        values |= {"evaluation.every": steps, "evaluation.subdivision.side": 1}
        for name, phase in config.phase.items():
            if phase and "steps" in phase:
                values[f"phase.{name}.steps"] = min(phase["steps"], steps)
    return with_values(config, values)


def training_device(config: DictConfig) -> str:
    """Return the kind of device that a run trains on, `cpu`, `cuda` or `mps`; `auto` means the CPU."""
    return "cpu" if (gpu := find_gpu()) is None or config.trainer.accelerator in ("auto", "cpu") else gpu.type


def require_data(config: DictConfig) -> None:
    """Refuse the missing data of a synthetic scene; the message names the command that renders the scene."""
    scene, root = scene_name(config.data.root), resolve_path(config.data.root)
    if not root.exists() and (CONF_DIR / "scene" / f"{scene}.yaml").is_file():
        small = ["resolution=128", "spp=256", "test_spp=1024", "views.val=10", "views.test=20"]
        command = command_line("synthesize", [*as_overrides({"scene": scene, "out": root}), *small])
        raise NerfroError(f"{root} holds no data yet; run {command} first")


def require_inputs(config: DictConfig) -> None:
    """Refuse a configuration whose device or photographs are missing on this machine; images are not decoded.

    Raises:
        NerfroError: there is no such device, or the folder of the data lacks a file or has a damaged one.
    """
    require_accelerator(config.trainer.accelerator)
    require_data(config)
    try:
        _data(config, np.zeros(3)).load("train")  # reading the mesh for its origin takes a second
    except NerfroError:
        build_data(config).load("train")


def build_data(config: DictConfig) -> DataSource:
    """Build the data set of a run, with the origin of its medium.

    A `val` split is made of training views if `num_validation_views` is set.
    """
    return _data(config, origin_of(OmegaConf.select(config, "medium")))


def _data(config: DictConfig, origin: Float[np.ndarray, "3"]) -> DataSource:
    source, number = build(config.data).with_origin(origin), config.batches.num_validation_views
    return WithValidationViews(source, number) if number else source


def build_each(plugin_type: str, nodes: DictConfig) -> dict[str, Any]:
    """Build the plugins of a type of which a run may have several, from the nodes `TYPE.<registered name>`.

    Args:
        plugin_type: type of the plugins, such as `loss`.
        nodes: configuration nodes of all plugins.

    Raises:
        NerfroError: there is no loss, or a node does not fit its plugin.
    """
    if plugin_type == "loss" and not nodes:
        raise NerfroError("there is no loss to train with; add one, such as +loss.photometric.weight=1")
    built = {}
    for name in map(str, nodes):
        node = {} if nodes[name] is None else nodes[name]
        if not isinstance(node, Mapping):
            setting = "weight" if plugin_type == "loss" else "SETTING"
            raise NerfroError(
                f"{plugin_type}.{name}={node} is not a set of settings; write {plugin_type}.{name}.{setting}={node}"
            )
        built[name] = create(find(plugin_type, name), node)
    return built


def build_medium(config: DictConfig) -> Medium:
    """Build the medium of a run, which is empty if the path sampler needs none."""
    needs_medium = plugin_of(config.sampler.path).cls.needs_medium  # type: ignore[attr-defined]
    medium: Medium = build(config.medium) if needs_medium else Vacuum()
    return medium


def build_model(config: DictConfig, medium: Medium | None = None) -> Renderer:
    """Compose the model of a complete configuration, see `derivation.derived`.

    Args:
        config: configuration of the run, see `TrainConfig`.
        medium: medium of the run; None to build it.

    Raises:
        NerfroError: a component cannot be built.
    """
    space = space_of(config.content)
    components = Components(
        medium=build_medium(config) if medium is None else medium,
        path_sampler=build(config.sampler.path),
        point_sampler=build(config.sampler.points, space=space),
        make_field=lambda: build(config.field, space=space),
        background=build(config.background),
        camera=build(config.camera),
        space=space,
        chunk_size=config.evaluation.chunk_size,
    )
    renderer: Renderer = build(config.model, components=components)
    return renderer
