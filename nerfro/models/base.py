"""What all models share: losses, optimiser, logging and rendering of whole images. Nothing physical is written here."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from nerfro.allowed import checked
from nerfro.boundaries.base import Boundary, background_radiance
from nerfro.camera.base import Camera
from nerfro.camera.given import GivenCamera
from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.geometry.interpolation import intersect_box
from nerfro.light import clipped_alike, to_linear, to_srgb
from nerfro.losses.base import Loss
from nerfro.media.base import Medium
from nerfro.models.optimizer import OptimizerConfig, learning_rate_factor, training_progress
from nerfro.samplers.base import PathSampler, PointSampler
from nerfro.samplers.surface_normals import first_normals
from nerfro.types import Batch, Exits, Path, Rays, Rendering


@dataclass(frozen=True)
class Parts:
    """What a model is composed of."""

    medium: Medium  # refractive index
    # How rays become paths and paths samples.
    path_sampler: PathSampler
    point_sampler: PointSampler
    make_field: Callable[[], Field]  # makes a new radiance field
    boundary: Boundary  # what lies beyond the volume
    losses: Mapping[str, Loss]  # training losses by name
    optimizer: OptimizerConfig  # settings of Adam
    camera: Camera = dataclasses.field(default_factory=GivenCamera)  # what is believed of the training cameras
    seed: int = 0  # of all random draws in training
    chunk_size: int = 8192  # rays rendered at once in evaluation, which bounds its memory


@checked("model")
class NerfModel(LightningModule, ABC):
    """Renders rays and learns from pixels; a model adds how many fields there are and where the boundary is asked.

    Args:
        parts: what the model is composed of.
        fields: radiance field of each sampling level, or one for all.
        colour: what fields and boundary return and rays add up: `linear` radiance, or `srgb` as in the authors' code.
    """

    # Whether a straight path that meets nothing shows the boundary in its direction: pictures need no samples on it.
    empty_shows_boundary = False

    def __init__(self, parts: Parts, fields: list[Field], colour: Literal["linear", "srgb"] = "linear") -> None:
        super().__init__()
        self.colour = colour
        self.camera, self.medium = parts.camera, parts.medium
        self.path_sampler, self.point_sampler = parts.path_sampler, parts.point_sampler
        self.fields = nn.ModuleList(fields)
        self.boundary = parts.boundary
        self.losses = nn.ModuleDict(dict(parts.losses))
        if colour == "srgb" and self.camera.exposure is not None:
            raise NerfroError("camera.exposure=true needs linear radiance; take model.colour=linear")
        self.optimizer_config, self.chunk_size, self.seed = parts.optimizer, parts.chunk_size, parts.seed
        self._written = True  # whether what this step logs is

    @abstractmethod
    def render_path(
        self, path: Path, draws: Draws | None = None, teaches_background: Bool[Tensor, "R"] | None = None
    ) -> list[Rendering]:
        """Render paths.

        Args:
            path: P polylines of R rays.
            draws: random numbers of a training step; None in evaluation, which is deterministic.
            teaches_background: rays from which the background learns; None for all. See `background`.

        Returns:
            One rendering for each sampling level.
        """

    def forward(self, rays: Rays, draws: Draws | None = None) -> list[Rendering]:
        """Bend rays and render their paths."""
        return self.render_path(self.trace(rays), draws)

    def background(
        self,
        path: Path,
        teaches_background: Bool[Tensor, "R"] | None = None,
        directions: Float[Tensor, "P 3"] | None = None,
    ) -> Float[Tensor, "P 3"]:
        """Evaluate the background radiance where polylines leave, or in other `directions`; some rays teach it."""
        teaches = None if teaches_background is None else path.of_ray(teaches_background)
        return background_radiance(self.boundary, path.exits(directions), teaches)

    def trace(self, rays: Rays, path: Path | None = None) -> Path:
        """Paths of rays, or the given ones, tinted by the medium; with gradients by what bends and learns."""
        path = self.path_sampler(rays, self.medium) if path is None else path
        return self.medium.tinted(self.refined(path, rays) if self.paths_learn else path)

    def exit_directions(self, rays: Rays) -> Float[Tensor, "R 3"]:
        """Unit direction in which the main polyline of each ray leaves, without its branches and their cost."""
        return self.path_sampler.main(rays, self.medium).exit_directions

    def refined(self, path: Path, rays: Rays) -> Path:
        """Paths with gradients, but for those whose derivatives are too large, or not yet to be learned from."""
        steady = self.path_sampler.steady(path, self.medium)
        if steady.all():
            return self.path_sampler.refine(path, rays, self.medium)
        rows = steady.nonzero()[:, 0]
        if not len(rows):
            return path
        # The others are not replayed at all: they have many events, and take most of the time.
        refined = self.path_sampler.refine(path[rows], rays[path.ray[rows]], self.medium)
        names = ["positions", "directions", "s", "exit_directions", *(["throughput"] if path.splits else [])]
        return path.changed(**{n: getattr(path, n).index_copy(0, rows, getattr(refined, n)) for n in names})

    @property
    def paths_learn(self) -> bool:
        """Whether paths change while training: then none may be traced before the step that needs it."""
        bending = [
            *self.camera.bending_parameters(),
            *self.medium.bending_parameters(),
            *self.path_sampler.parameters(),
        ]
        return torch.is_grad_enabled() and any(parameter.requires_grad for parameter in bending)

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """All that learns: parameters and initial learning rate by name. A model that adds parameters adds a group."""
        config, bending = self.optimizer_config, self.medium.bending_parameters()
        tint = [own for own in self.medium.parameters() if all(own is not other for other in bending)]
        groups = {
            "fields": (list(self.fields.parameters()), config.learning_rate),
            "boundary": (list(self.boundary.parameters()), config.rate("boundary")),
            "medium": ([*bending, *self.path_sampler.parameters()], config.rate("medium")),
            "tint": (tint, config.rate("tint")),
            "camera": (self.camera.bending_parameters(), config.rate("camera")),
            "exposure": (self.camera.brightness_parameters(), config.rate("exposure")),
        }
        return {name: group for name, group in groups.items() if group[0]}

    def encode(
        self, radiance: Float[Tensor, "*batch 3"], gains: Float[Tensor, "*batch 3"] | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """What rays add up to, times the gains, as sRGB; not clipped, so that what is too bright keeps its gradient."""
        radiance = radiance if gains is None else radiance * gains
        return radiance if self.colour == "srgb" else to_srgb(radiance)

    def photographed(
        self, radiance: Float[Tensor, "*batch 3"], gains: Float[Tensor, "*batch 3"] | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """What photographs show of radiance times the gains: sRGB in [0, 1]."""
        return self.encode(radiance, gains).clamp(0, 1)

    def linear(self, radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """What fields, boundary and rays have, as linear radiance."""
        return to_linear(radiance.clamp(min=0)) if self.colour == "srgb" else radiance

    def difference(
        self,
        radiance: Float[Tensor, "*batch 3"],
        rgb: Float[Tensor, "*batch 3"],
        gains: Float[Tensor, "*batch 3"] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Prediction, of radiance times the gains, and target, both sRGB, for a loss to compare.

        They are equal where both are brighter than a photograph can tell.
        """
        prediction = self.encode(radiance, gains)
        return prediction, rgb if self.colour == "srgb" else clipped_alike(rgb, prediction)

    def training_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """The loss of a batch, and the mean squared error of its pixels (sRGB)."""
        path = self.trace(self.camera(batch.rays, batch.ray_view), batch.path)
        renderings = self.render_path(path, batch.draws, batch.teaches_background[batch.pixel])
        if (gains := self.camera.gains(batch.ray_view)) is not None:
            renderings = [rendering.exposed(gains) for rendering in renderings]
        total = torch.zeros((), device=self.device)
        for name, loss in self.losses.items():
            weight = loss.weight_at(self.global_step)  # type: ignore[operator]
            self.log(f"weight/{name}", weight)
            if weight > 0:
                value = loss(renderings, batch, self)
                self.log(f"loss/{name}", value)
                total = total + weight * value
        shown = self.photographed(batch.per_pixel(renderings[-1].rgb.detach()))
        error = (shown - batch.rgb).square().mean()
        self.log("train/psnr", -10 * torch.log10(error))
        self.log("loss/total", total)
        for name, value in self.medium.learned().items():
            self.log(f"medium/{name}", value)
        for name, value in self.camera.learned().items():
            self.log(f"camera/{name}", value)
        return {"loss": total, "squared_error": error}

    def log(self, *args: Any, **kwargs: Any) -> None:
        """Lightning's, but nothing in training steps that are not written: noting numbers took a tenth of a step."""
        if self._written or not self.trainer.training:
            super().log(*args, **kwargs)

    def on_train_batch_start(self, batch: Batch, batch_index: int) -> None:
        every: int = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        self._written = (self.global_step + 1) % every == 0
        factor = learning_rate_factor(self.global_step, training_progress(self.trainer), self.optimizer_config)
        for group in self.trainer.optimizers[0].param_groups:
            waits = self.global_step < self.optimizer_config.start(group["name"])
            group["lr"] = 0.0 if waits else group["initial_lr"] * factor
        # Not at the end of the step before, which comes after its checkpoint: a resumed run would miss the update.
        if self.global_step > 0:
            self.point_sampler.after_step(list(self.fields), batch.draws)  # type: ignore[arg-type]

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [
            {"params": parameters, "lr": rate, "initial_lr": rate, "name": name}
            for name, (parameters, rate) in self.parameter_groups().items()
        ]
        # Lightning cannot clip the gradients of a fused optimiser under mixed precision.
        fused = self._trainer is None or not self._trainer.gradient_clip_val
        return torch.optim.Adam(groups, eps=self.optimizer_config.adam_epsilon, fused=fused)

    def validation_step(self, view: int, batch_index: int) -> dict[str, Tensor] | None:
        if not self.trainer.is_global_zero:
            return None  # one process looks, the others wait
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        with torch.autocast(self.device.type, enabled=False):  # directions in half precision would miss their pixels
            held = data.watched_psnr()
        self.log("val/psnr", held, prog_bar=True, batch_size=1, rank_zero_only=True)
        if view < 0:
            return None  # no picture is due
        views = data.validation
        target = views.images[view].to(self.device)
        with torch.autocast(self.device.type, enabled=False):
            rays = views.cameras.to(self.device).image_rays(view)
        rendered = self.render(rays)
        prediction = self.photographed(rendered.radiance).reshape(target.shape)
        depth, opacity = (m.reshape(target.shape[:2]) for m in (rendered.depth / views.cameras.far, rendered.opacity))
        return {"prediction": prediction, "target": target, "depth": depth, "opacity": opacity}

    @torch.inference_mode()
    def render(self, rays: Rays) -> RenderedRays:
        """Render any number of rays in chunks, as in evaluation.

        Memory is bounded by `chunk_size` rays' samples and activations plus the result.
        """
        return RenderedRays(*self._in_chunks(self._render_chunk, rays))

    @torch.no_grad()
    def radiance(self, rays: Rays) -> Float[Tensor, "R 3"]:
        """What rays add up to, without what else `render` tells."""
        return self._in_chunks(lambda chunk: self._render_traced(chunk, self.trace(chunk)), rays)[0]

    @torch.no_grad()
    def shown(self, rays: Rays, gains: Float[Tensor, "R 3"] | None = None) -> Float[Tensor, "R 3"]:
        """What photographs would show along rays: sRGB in [0, 1], of radiance times the gains."""
        return self.photographed(self.radiance(rays), gains)

    def _in_chunks(self, render: Callable[[Rays], tuple[Tensor, ...]], rays: Rays) -> list[Tensor]:
        """What is rendered of `chunk_size` rays at a time, as in evaluation, put together."""
        was_training = self.training
        self.eval()
        try:
            chunks = [render(rays[i : i + self.chunk_size]) for i in range(0, len(rays), self.chunk_size)]
        finally:
            self.train(was_training)
        return [torch.cat(parts) for parts in zip(*chunks, strict=True)]

    def _render_chunk(self, rays: Rays) -> tuple[Tensor, ...]:
        path = self.trace(rays)
        exits, normals = path.first_of_ray(path.exit_directions), first_normals(path, self.medium)
        return *self._render_traced(rays, path), exits, normals

    def _render_traced(self, rays: Rays, path: Path) -> tuple[Tensor, Tensor, Tensor]:
        """Radiance, depth and opacity of rays by their paths."""
        meets = self._may_meet(rays, path)
        if meets.all():
            rendering = self.render_path(path)[-1]
            return rendering.rgb, rendering.depth, rendering.opacity
        # Most rays of a picture pass by the object, unbent.
        rgb, depth = torch.empty_like(rays.directions), path.first_of_ray(path.far).clone()
        opacity = torch.zeros_like(depth)
        passing, rows = (~meets).nonzero()[:, 0], meets.nonzero()[:, 0]
        rgb[passing] = self.boundary(Exits.unbent(rays[passing])).to(rgb)
        if len(rows):
            rendering = self.render_path(path.of_rays(rows))[-1]
            rgb[rows], depth[rows], opacity[rows] = (
                part.to(rgb) for part in (rendering.rgb, rendering.depth, rendering.opacity)
            )
        return rgb, depth, opacity

    def _may_meet(self, rays: Rays, path: Path) -> Bool[Tensor, "R"]:
        """Which rays may meet what the fields hold; the others are straight, and show the boundary."""
        meets = torch.full((len(rays),), not self.empty_shows_boundary, device=rays.near.device)
        for field in self.fields:
            box: Tensor | None = field.bounds  # type: ignore[assignment]
            if box is None:
                return torch.ones_like(meets)
            enter, leave = intersect_box(box, rays.origins, rays.directions)
            meets |= (enter <= leave) & (leave >= 0)
        meets[path.ray[path.refracted]] = True
        return meets


@dataclass(frozen=True)
class RenderedRays:
    """What evaluation keeps: radiance as the model adds it up, expected arc length, opacity and leaving direction.

    And the unit normal where the ray first meets the surface; zero where it does not.
    """

    radiance: Float[Tensor, "R 3"]
    depth: Float[Tensor, "R"]
    opacity: Float[Tensor, "R"]
    exit_directions: Float[Tensor, "R 3"]
    normals: Float[Tensor, "R 3"]


def psnr(prediction: Tensor, target: Tensor) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio of values in [0, 1], dB."""
    return -10 * torch.log10((prediction - target).square().mean())
