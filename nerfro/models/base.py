"""What all models share: losses, optimiser, logging and rendering of whole images. Nothing physical is written here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from nerfro.boundaries.base import Boundary
from nerfro.distributed import drawing_for
from nerfro.evaluation.pictures import triptych
from nerfro.fields.base import Field
from nerfro.losses.base import Loss
from nerfro.media.base import Medium
from nerfro.models.optimizer import OptimizerConfig, learning_rate_factor, training_progress
from nerfro.samplers.base import PathSampler, PointSampler
from nerfro.samplers.training_paths import TrainingPaths
from nerfro.types import Batch, Path, Rays, Rendering


@dataclass(frozen=True)
class Parts:
    """What a model is composed of.

    Attributes:
        medium: refractive index.
        path_sampler, point_sampler: how rays become paths and paths samples.
        make_field: makes a new radiance field.
        boundary: what lies beyond the volume.
        losses: training losses by name.
        optimizer: settings of Adam.
        seed: of all random draws in training.
        chunk_size: rays rendered at once in evaluation, which bounds its memory.
    """

    medium: Medium
    path_sampler: PathSampler
    point_sampler: PointSampler
    make_field: Callable[[], Field]
    boundary: Boundary
    losses: Mapping[str, Loss]
    optimizer: OptimizerConfig
    seed: int = 0
    chunk_size: int = 8192


class NerfModel(LightningModule, ABC):
    """Renders rays and learns from pixels; a model adds how many fields there are and where the boundary is asked.

    Args:
        parts: what the model is composed of.
        fields: radiance field of each sampling level, or one for all.

    Attributes:
        training_paths: training paths that are known already; nerfro.train sets it where rays do not change.
    """

    training_paths: TrainingPaths | None

    def __init__(self, parts: Parts, fields: list[Field]) -> None:
        super().__init__()
        self.medium = parts.medium
        self.path_sampler, self.point_sampler = parts.path_sampler, parts.point_sampler
        self.fields = nn.ModuleList(fields)
        self.boundary = parts.boundary
        self.losses = nn.ModuleDict(dict(parts.losses))
        self.training_paths = None
        self.optimizer_config, self.chunk_size, self.seed = parts.optimizer, parts.chunk_size, parts.seed

    @abstractmethod
    def render_path(self, path: Path) -> list[Rendering]:
        """Render paths, one rendering for each sampling level."""

    def forward(self, rays: Rays) -> list[Rendering]:
        """Bend rays and render their paths."""
        return self.render_path(self.path_sampler(rays, self.medium))

    def training_step(self, batch: Batch, batch_index: int) -> Float[Tensor, ""]:
        known = None if self.training_paths is None else self.training_paths(batch)
        with drawing_for(batch.rows, batch.num_rows):
            renderings: list[Rendering] = self(batch.rays) if known is None else self.render_path(known)
        total = torch.zeros((), device=self.device)
        for name, loss in self.losses.items():
            weight = loss.weight_at(self.global_step)  # type: ignore[operator]
            self.log(f"weight/{name}", weight)
            if weight > 0:
                value = loss(renderings, batch, self)
                self.log(f"loss/{name}", value)
                total = total + weight * value
        error = (batch.pixel_colours(renderings[-1].rgb.detach()) - batch.pixel_colours(batch.rgb)).square().mean()
        self.log("train/psnr", -10 * torch.log10(error), prog_bar=True)
        self.log("loss/total", total)
        return total

    def on_train_batch_start(self, batch: Batch, batch_index: int) -> None:
        # Every step draws from its own seed, so that a resumed run repeats the steps of an undisturbed one.
        # All processes have the same one: each takes its rays' share of what is drawn.
        torch.manual_seed(step_seed(self.seed, self.global_step))
        # Under a time limit every process has its own idea of it, and parameters would drift apart at different rates.
        progress = self.trainer.strategy.broadcast(training_progress(self.trainer))
        factor = learning_rate_factor(self.global_step, progress, self.optimizer_config)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = group["initial_lr"] * factor
        # Not at the end of the step before, which comes after its checkpoint: a resumed run would miss the update.
        if self.global_step > 0:
            self.point_sampler.after_step(self.global_step, list(self.fields))  # type: ignore[arg-type]
            self.boundary.after_step(self.global_step)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        config = self.optimizer_config
        rates = {self.fields: config.learning_rate, self.boundary: config.boundary_rate}
        groups = [{"params": list(part.parameters()), "lr": rate, "initial_lr": rate} for part, rate in rates.items()]
        # Lightning cannot clip the gradients of a fused optimiser under mixed precision.
        fused = self._trainer is None or not self._trainer.gradient_clip_val
        return torch.optim.Adam([g for g in groups if g["params"]], eps=config.adam_epsilon, fused=fused)

    def validation_step(self, view: int, batch_index: int) -> dict[str, Tensor] | None:
        if not self.trainer.is_global_zero:
            return None  # one process looks, the others wait
        views = self.trainer.datamodule.validation  # type: ignore[attr-defined]
        target = views.images[view].to(self.device)
        with torch.autocast(self.device.type, enabled=False):  # directions in half precision would miss their pixels
            rays = views.cameras.to(self.device).image_rays(view)
        rendered = self.render(rays)
        prediction = rendered.rgb.reshape(target.shape)
        psnr = -10 * torch.log10((prediction - target).square().mean())
        self.log("val/psnr", psnr, prog_bar=True, batch_size=1, rank_zero_only=True)
        far = views.cameras.far
        maps = [m.reshape(*target.shape[:2], 1).expand_as(target) for m in (rendered.depth / far, rendered.opacity)]
        return {
            "val/prediction_reference_error": triptych(prediction, target),
            "val/depth_opacity": torch.cat(maps, dim=1).clamp(0, 1),
        }

    @torch.inference_mode()
    def render(self, rays: Rays) -> RenderedRays:
        """Render any number of rays in chunks, as in evaluation.

        Memory is bounded by `chunk_size` rays' samples and activations plus the result.
        """
        was_training = self.training
        self.eval()
        try:
            chunks = [self._render_chunk(rays[i : i + self.chunk_size]) for i in range(0, len(rays), self.chunk_size)]
        finally:
            self.train(was_training)
        return RenderedRays(*(torch.cat(parts) for parts in zip(*chunks, strict=True)))

    def _render_chunk(self, rays: Rays) -> tuple[Tensor, ...]:
        rendering = self(rays)[-1]
        return rendering.rgb.clamp(0, 1), rendering.depth, rendering.opacity, rendering.path.exit_directions


@dataclass(frozen=True)
class RenderedRays:
    """What evaluation keeps: colour (sRGB in [0, 1]), expected arc length, opacity and leaving direction."""

    rgb: Float[Tensor, "R 3"]
    depth: Float[Tensor, "R"]
    opacity: Float[Tensor, "R"]
    exit_directions: Float[Tensor, "R 3"]


def step_seed(seed: int, step: int) -> int:
    """A seed for one step, from the run's (Weyl sequence; distinct for neighbouring arguments)."""
    return (seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9) % 2**63
