"""The typed root of a training run's configuration, and the model that it composes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Optional

from omegaconf import MISSING, DictConfig

from nerfro.errors import NerfroError
from nerfro.losses.base import Loss
from nerfro.media.analytic import Vacuum
from nerfro.models.base import NerfModel, Parts
from nerfro.models.optimizer import OptimizerConfig
from nerfro.registry import build, configure, find


@dataclass
class SamplerConfig:
    """How rays become paths and paths samples.

    Attributes:
        path: plugin of kind `sampler/path`.
        points: plugin of kind `sampler/points`.
    """

    path: Any = MISSING
    points: Any = MISSING


@dataclass
class BatchesConfig:
    """Which pixels are trained on.

    Attributes:
        size: rays of a step.
        batching: pixels of `single_image` at a time, or of `all_images`.
        jitter: draw each ray anywhere inside its pixel instead of through its centre.
        precrop_steps: number of first steps that see only the central window of the images.
        precrop_fraction: side of that window.
    """

    size: int = 1024
    batching: str = "single_image"
    jitter: bool = False
    precrop_steps: int = 0
    precrop_fraction: float = 0.5


@dataclass
class EvaluationConfig:
    """How a trained model is evaluated.

    Attributes:
        split: of the data.
        chunk_size: rays rendered at once; bounds the memory.
        lpips_backbone: file of AlexNet weights; none looks in torch's hub cache and then on the network.
        every: steps between two looks at one validation image while training; 0 for never.
        supersample: rays along each side of a pixel that is supersampled, see `divergence`; 1 for one central ray.
        divergence: supersample pixels whose exit direction differs from a neighbour's by this many pixels; 0 for all.
    """

    split: str = "test"
    chunk_size: int = 8192
    lpips_backbone: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    every: int = 500
    supersample: int = 1
    divergence: float = 0.0


@dataclass
class CheckpointConfig:
    """When a checkpoint is written while training; one of the two. The last one is kept.

    Attributes:
        every_seconds, every_steps: interval.
    """

    every_seconds: Optional[float] = 60.0  # noqa: UP045
    every_steps: Optional[int] = None  # noqa: UP045


@dataclass
class AuthorsConfig:
    """What the authors of the paper set for a scene, taken up by the `paper_*` experiments alone.

    Attributes:
        resolution: vertices a side of the index grid.
        smoothing_size, smoothing_sigma: taps and standard deviation (voxels) of its smoothing.
        num_steps: Eikonal steps, N_c x N_e.
        boundary_weight: of the boundary regulariser.
        max_steps: iterations.
    """

    resolution: int = 512
    smoothing_size: int = 9
    smoothing_sigma: float = 1.0
    num_steps: int = 768
    boundary_weight: float = 0.025
    max_steps: int = 200_000


@dataclass
class TrainConfig:
    """Everything that `python -m nerfro.train` composes from conf/train.yaml.

    Attributes:
        name: of the experiment; names the run folder.
        seed: of initialisation and of all random draws.
        data, medium, field, boundary, model: one plugin of that kind.
        sampler: path and point sampler.
        loss: fields of each training loss, by the loss's registered name.
        authors, optimizer, batches, evaluation, checkpoint: see there.
        trainer, logger: Lightning objects.
        ckpt_path: checkpoint to go on from, or `last` for the newest of this experiment.
    """

    name: str = "refractive"
    seed: int = 0
    data: Any = MISSING
    medium: Any = MISSING
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)
    field: Any = MISSING
    boundary: Any = MISSING
    model: Any = MISSING
    loss: dict[str, Any] = dataclasses.field(default_factory=dict)
    authors: AuthorsConfig = dataclasses.field(default_factory=AuthorsConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    batches: BatchesConfig = dataclasses.field(default_factory=BatchesConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    trainer: Any = MISSING
    logger: Any = None
    ckpt_path: Optional[str] = None  # noqa: UP045


def build_losses(nodes: DictConfig) -> dict[str, Loss]:
    """Build the training losses from `loss.<registered name>.<field>`.

    Raises:
        NerfroError: no loss is registered under a name, or a field is wrong.
    """
    plugins = {str(name): find("loss", str(name)) for name in nodes}
    return {name: plugin.cls(**configure(plugin, nodes[name] or {})) for name, plugin in plugins.items()}


def build_model(config: DictConfig) -> NerfModel:
    """Compose the model of a configuration (see `TrainConfig`).

    Raises:
        NerfroError: a part is not registered or is configured wrongly.
    """
    if config.evaluation.chunk_size < 1:
        raise NerfroError(f"evaluation.chunk_size={config.evaluation.chunk_size} renders nothing; take 1 or more")
    losses = build_losses(config.loss)
    optimizer = OptimizerConfig(**config.optimizer)
    path_sampler, point_sampler = build(config.sampler.path), build(config.sampler.points)
    boundary = build(config.boundary)
    # Last, since voxelisation takes longest.
    medium = build(config.medium) if path_sampler.needs_medium else Vacuum()
    parts = Parts(
        medium=medium,
        path_sampler=path_sampler,
        point_sampler=point_sampler,
        make_field=lambda: build(config.field),
        boundary=boundary,
        losses=losses,
        optimizer=optimizer,
        seed=config.seed,
        chunk_size=config.evaluation.chunk_size,
    )
    return build(config.model, parts=parts)
