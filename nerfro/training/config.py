"""The typed root of a training run's configuration, and the model that it composes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Optional

from omegaconf import MISSING, DictConfig, OmegaConf

from nerfro.allowed import Count, Natural, NotNegative, NumRays, Positive, Range, Resolution, Side
from nerfro.data.base import DataSource, Views
from nerfro.data.exposure import exif_exposures
from nerfro.data.validation_views import WithValidationViews
from nerfro.errors import NerfroError
from nerfro.losses.base import Loss
from nerfro.media.analytic import Vacuum
from nerfro.models.base import NerfModel, Parts
from nerfro.models.optimizer import OptimizerConfig
from nerfro.registry import build, create, find
from nerfro.training.backdrop import settle_backdrop
from nerfro.training.content import ContentConfig, settle_content


@dataclass
class SamplerConfig:
    """How rays become paths and paths samples."""

    path: Any = MISSING  # plugin of kind `sampler/path`
    points: Any = MISSING  # plugin of kind `sampler/points`


@dataclass
class BatchesConfig:
    """Which pixels are trained on."""

    size: NumRays = 1024  # pixels of a step
    # Pixels of `single_image` at a time, or of `all_images`.
    batching: Annotated[str, Literal["single_image", "all_images"]] = "single_image"
    jitter: bool = False  # draw each ray anywhere inside its pixel instead of through its centre
    # Share of the pixels of a step that is drawn of the object's alone, which masks tell; the others are of all pixels.
    object_fraction: Annotated[float, Range(at_least=0, at_most=1)] = 0.0
    # Training views, spread over the cameras' places, that are not trained on: they are the `val` split then.
    num_validation_views: Natural = 0
    precrop_steps: Natural = 0  # number of first steps that see only the central window of the images
    precrop_fraction: Annotated[float, Range(more_than=0, at_most=1)] = 0.5  # side of that window
    # Rays in each direction of a pixel whose ray leaves `divergence` pixels or more away from the ray beside it;
    # 1 gives all pixels one ray.
    supersample: Side = 1
    divergence: NotNegative = 8.0
    # And of a pixel of the object whose photograph differs from a neighbour's by this much (sRGB); none for no others.
    contrast: Optional[Positive] = None  # noqa: UP045
    contrast_start: Natural = 0  # steps before: details are learned last, and more rays make slower steps


@dataclass
class EvaluationConfig:
    """How a trained model is evaluated."""

    split: str = "test"  # of the data
    chunk_size: NumRays = 8192  # rays rendered at once; bounds the memory
    # File of AlexNet weights; none looks in torch's hub cache and then on the network.
    lpips_backbone: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    # File of VGG-16 weights; none looks in torch's hub cache only.
    lpips_vgg_backbone: Optional[str] = None  # noqa: UP045
    # Steps between two pictures of validation views while training; PSNR of some of their pixels is taken five times as
    # often. 0 for never.
    every: Natural = 500
    # Rays along each side of a pixel that is supersampled, see `divergence`; 1 for one central ray.
    supersample: Side = 1
    # Supersample pixels whose ray leaves this many pixels or more away from the one beside it; 0 for all.
    divergence: NotNegative = 0.0
    # And pixels whose colour differs from a neighbour's by this much (sRGB); none for no others.
    contrast: Optional[Positive] = None  # noqa: UP045
    # Steps in which test cameras are refined on the left halves of their photographs, to be scored on the right ones
    # under a name of their own; 0 for none.
    refine_steps: Natural = 0


@dataclass
class CheckpointConfig:
    """When a checkpoint is written while training; one of the two. The last one is kept."""

    every_seconds: Optional[Positive] = 60.0  # noqa: UP045
    every_steps: Optional[Count] = None  # noqa: UP045


@dataclass
class TrainerConfig:
    """Lightning's Trainer: those of its arguments that mean something here. None is Lightning's default."""

    _target_: str = "lightning.pytorch.Trainer"
    accelerator: str = "auto"
    devices: Any = 1
    num_nodes: Optional[Count] = None  # noqa: UP045
    strategy: Any = "auto"
    max_steps: Annotated[int, Range(at_least=-1, at_most=10**9)] = -1  # -1 for as many as max_time allows
    max_time: Any = None  # DD:HH:MM:SS
    # `fastest` is bf16-mixed where the machine has units for it, else 32-true.
    precision: Annotated[str, Literal["32-true", "fastest", "16-mixed", "bf16-mixed", "64-true"]] = "32-true"
    gradient_clip_val: Optional[Positive] = None  # noqa: UP045
    gradient_clip_algorithm: Annotated[Optional[str], Literal["norm", "value"]] = None  # noqa: UP045
    accumulate_grad_batches: Optional[Count] = None  # noqa: UP045
    log_every_n_steps: Count = 50
    deterministic: Any = None
    benchmark: Optional[bool] = None  # noqa: UP045
    detect_anomaly: Optional[bool] = None  # noqa: UP045
    profiler: Optional[str] = None  # noqa: UP045
    enable_model_summary: bool = False


@dataclass
class AuthorsConfig:
    """What the authors of the paper set for a scene, taken up by their experiments: `paper_*`, `ablation_euler`."""

    # Corners of the index grid, world units, and its vertices a side.
    box_min: list[float] = dataclasses.field(default_factory=lambda: [-1.5] * 3)
    box_max: list[float] = dataclasses.field(default_factory=lambda: [1.5] * 3)
    resolution: Resolution = 512
    # Taps and standard deviation (voxels) of its smoothing.
    smoothing_size: Natural = 9
    smoothing_sigma: Positive = 1.0
    num_steps: Count = 768  # Eikonal steps, N_c x N_e
    boundary_weight: NotNegative = 0.025  # of the boundary regulariser
    max_steps: Count = 200_000  # iterations


@dataclass
class TrainConfig:
    """Everything that `python -m nerfro.train` composes from conf/train.yaml."""

    name: str = "refractive"  # of the experiment; names the run folder
    seed: Annotated[int, Range(at_least=0, at_most=2**32 - 1)] = 0  # of initialisation and of all random draws
    # data, camera, medium, field, boundary, model: one plugin of that kind.
    data: Any = MISSING
    camera: Any = MISSING
    medium: Any = MISSING
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)  # path and point sampler
    field: Any = MISSING
    boundary: Any = MISSING
    model: Any = MISSING
    # Fields of each training loss, by the loss's registered name.
    loss: dict[str, Any] = dataclasses.field(default_factory=dict)
    content: ContentConfig = dataclasses.field(default_factory=ContentConfig)
    authors: AuthorsConfig = dataclasses.field(default_factory=AuthorsConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    batches: BatchesConfig = dataclasses.field(default_factory=BatchesConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    trainer: TrainerConfig = dataclasses.field(default_factory=TrainerConfig)
    logger: Any = None  # Lightning objects by any name
    # Checkpoint to go on from, or `last` for the newest of this experiment.
    ckpt_path: Optional[str] = None  # noqa: UP045
    viewer: bool = False  # serve an interactive page of the model while it trains, to this machine's browsers
    viewer_port: Annotated[int, Range(at_least=0, at_most=65535)] = 8008  # that it is served on; 0 for any free one
    # Backend of torch.compile for the networks, such as inductor or cudagraphs on a GPU; none runs them as they
    # are. Compiling takes a minute or more at the start.
    compile: Optional[str] = None  # noqa: UP045


def build_data(config: DictConfig) -> DataSource:
    """The data of a run; views that it holds back are their `val` split."""
    source = build(config.data)
    number = OmegaConf.select(config, "batches.num_validation_views")  # checkpoints of older releases lack it
    return WithValidationViews(source, number) if number else source


def build_losses(nodes: DictConfig, known: bool = True) -> dict[str, Loss]:
    """Build the training losses from `loss.<registered name>.<field>`.

    Args:
        nodes: of all losses.
        known: whether what the fields follow from is known; if not, those keep their defaults.
    """
    if not nodes:
        raise NerfroError("there is no loss to train with; give one, such as +loss.photometric.weight=1")
    losses = {}
    for name in map(str, nodes):
        node = {} if nodes[name] is None else nodes[name]
        if not isinstance(node, Mapping):
            raise NerfroError(f"loss.{name}={node} is no set of fields; write loss.{name}.weight={node} for its weight")
        plugin = find("loss", name)
        if not known:
            node = {field: node[field] for field in node if not OmegaConf.is_interpolation(node, field)}
        losses[name] = create(plugin, node)
    return losses


def build_model(config: DictConfig, training: Views | None = None) -> NerfModel:
    """Compose the model of a configuration (see `TrainConfig`); fills in what it leaves to the data.

    Args:
        config: of the run.
        training: views, where they are loaded already; without them, a checkpoint must tell what was believed of them.
    """
    build_losses(config.loss, known=False)  # mistakes are told before anything is read
    optimizer = OptimizerConfig(**config.optimizer)
    path_sampler = build(config.sampler.path)
    medium = build(config.medium) if path_sampler.needs_medium else Vacuum()
    settle_content(config, medium, None if training is None else training.cameras)
    camera = build(config.camera)
    if training is not None:
        settle_backdrop(config, training.images)
        exposures = None if camera.exposure is None else exif_exposures([f.image for f in training.frames])
        camera.begin(training.cameras, exposures)
    parts = Parts(
        medium=medium,
        path_sampler=path_sampler,
        point_sampler=build(config.sampler.points),
        make_field=lambda: build(config.field),
        boundary=build(config.boundary),
        camera=camera,
        losses=build_losses(config.loss),
        optimizer=optimizer,
        seed=config.seed,
        chunk_size=config.evaluation.chunk_size,
    )
    return build(config.model, parts=parts)
