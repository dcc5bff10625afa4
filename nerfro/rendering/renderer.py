"""The renderer, which traces rays and samples their paths; models derive from it and render the paths."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.func import functional_call

from nerfro.backgrounds.base import Background
from nerfro.camera.base import CameraModel, GivenCamera
from nerfro.core.light import Colour, ColourSpace
from nerfro.core.rays import Rays
from nerfro.core.types import Batch, Exits, Path, Rendering, Samples
from nerfro.data.component import Component
from nerfro.fields.base import Field
from nerfro.geometry.interpolation import intersect_box
from nerfro.geometry.space import Space, Unbounded
from nerfro.kernels.threads import share_rows
from nerfro.media.base import Medium
from nerfro.registry.allowed import validated
from nerfro.rendering.scene import Scene
from nerfro.samplers.base import PathSampler, PointSampler
from nerfro.samplers.paths.replay import first_normals

Result = TypeVar("Result")


@dataclass(frozen=True)
class Components:
    """Components of a model.

    Attributes:
        medium: refractive index and absorption.
        path_sampler: turns rays into paths.
        point_sampler: chooses samples on paths.
        make_field: makes a new radiance field; a model with several sampling levels has a field for each.
        background: background radiance, from beyond the volume.
        camera: estimate of the training cameras.
        space: space that fields and samples cover.
        chunk_size: number of rays that all cores render at once in evaluation, which limits the memory.
    """

    medium: Medium
    path_sampler: PathSampler
    point_sampler: PointSampler
    make_field: Callable[[], Field]
    background: Background
    camera: CameraModel = dataclasses.field(default_factory=GivenCamera)
    space: Space = dataclasses.field(default_factory=Unbounded)
    chunk_size: int = 8192


@dataclass(frozen=True)
class RenderedRays:
    """Result of rendering R rays in evaluation.

    Attributes:
        radiance: radiance in the colour space of the scene.
        depth: expected arc length along the path, world units.
        opacity: opacity of the fields, in [0, 1].
        exit_directions: unit directions in which the rays leave the volume.
        normals: unit normals, towards the camera, at the first surface of each ray; zero without a surface.
        refracted: whether the main polyline of each ray meets the medium, see `Path.refracted`.
    """

    radiance: Float[Tensor, "R 3"]
    depth: Float[Tensor, "R"]
    opacity: Float[Tensor, "R"]
    exit_directions: Float[Tensor, "R 3"]
    normals: Float[Tensor, "R 3"]
    refracted: Bool[Tensor, "R"]


@validated("model")
class Renderer(Component, nn.Module, ABC):
    """Render rays through a scene. Models derive from this class and implement `render_path`.

    Args:
        components: components of the model.
        num_fields: number of radiance fields: one for each sampling level, or one for all.
        colour: colour space in which fields and background return radiance and rays sum radiance: `linear`, `hdr` for
            photographs in linear light (see `ColourSpace`), or `srgb` as in the authors' code; None for `linear`.

    Attributes:
        scene: everything learned about the world.
        path_sampler, point_sampler: components that turn rays into paths, and choose samples on paths.
        chunk_size: number of rays that are rendered at once in evaluation.
    """

    # Whether straight paths outside of all fields show only the background, so that images need no samples there.
    empty_shows_background: ClassVar[bool] = False
    # Whether every step has gradients of all parameters, as data-parallel training requires.
    trains_in_parallel: ClassVar[bool] = True

    def __init__(self, components: Components, num_fields: int, colour: Colour | None = None) -> None:
        super().__init__()
        fields = [components.make_field() for _ in range(num_fields)]
        medium, background, camera = components.medium, components.background, components.camera
        self.scene = Scene(medium, fields, background, camera, ColourSpace(colour or "linear"), components.space)
        self.path_sampler, self.point_sampler = components.path_sampler, components.point_sampler
        self.chunk_size = components.chunk_size

    @abstractmethod
    def render_path(self, path: Path, batch: Batch | None = None) -> list[Rendering]:
        """Render paths: sample them, query the scene's fields and background, and composite; see `sample`.

        Args:
            path: P polylines of R rays.
            batch: batch of a training step with these rays; None in evaluation, which is deterministic.

        Returns:
            One rendering for each sampling level, the finest one last.
        """

    def begin_step(self, progress: float) -> float:
        """Prepare for a training step. Models with several stages of training override this method.

        Args:
            progress: fraction of the training budget, in [0, 1].

        Returns:
            Progress of the learning rate schedule, in [0, 1].
        """
        return progress

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        """Return the parameters of the scene and of the model itself by name, see `Scene.parameters_by_name`."""
        own = {name: value for name, value in self.named_parameters() if not name.startswith("scene.")}
        return self.scene.parameters_by_name() | own

    def forward(self, rays: Rays) -> list[Rendering]:
        """Trace rays and render their paths, one rendering for each sampling level."""
        return self.render_path(self.trace(rays))

    def render_batch(self, batch: Batch) -> list[Rendering]:
        """Render the rays of a training step, with the exposures of their photographs."""
        renderings = self.render_path(self.trace(batch.rays, batch.path), batch)
        gains = self.scene.camera.gains(batch.ray_view, batch.rays)
        return renderings if gains is None else [rendering.exposed(gains) for rendering in renderings]

    def sample(self, path: Path, previous: Rendering | None = None, batch: Batch | None = None) -> Samples:
        """Choose the samples of a level, unless they were chosen with the paths of the batch.

        Args:
            path: P polylines of R rays.
            previous: rendering of the previous level; None at the first level.
            batch: batch of a training step with these rays; None in evaluation.
        """
        if batch is None or batch.samples is None or previous is not None:
            return self.point_sampler(path, previous, None if batch is None else batch.draws)
        return batch.samples.on(path) if path.positions.requires_grad else batch.samples

    def background(
        self, path: Path, batch: Batch | None = None, directions: Float[Tensor, "P 3"] | None = None
    ) -> Float[Tensor, "P 3"]:
        """Evaluate the background radiance in the exit directions of polylines, or in other `directions`.

        Args:
            path: P polylines of R rays.
            batch: batch of a training step with these rays, which selects the rays from which the background learns;
                None for all.
            directions: unit directions that replace the exit directions.

        Returns:
            Background radiance of each polyline, in the colour space of the scene.
        """
        background, exits = self.scene.background, path.exits(directions)
        radiance = background(exits)
        if batch is None or not radiance.requires_grad:
            return radiance
        fixed = radiance.detach()
        if exits.directions.requires_grad:  # the exits of all rays have gradients
            parameters = {name: parameter.detach() for name, parameter in background.named_parameters()}
            fixed = functional_call(background, parameters, (exits,))
        teaches = path.broadcast_to_polylines(batch.teaches_background[batch.ray_pixel])
        return torch.where(teaches[:, None], radiance, fixed)

    def trace(self, rays: Rays, path: Path | None = None) -> Path:
        """Trace rays, or add gradients and absorption to paths that were traced before."""
        medium = self.scene.medium
        path = self.path_sampler(rays, medium) if path is None else path
        learns = self.paths_learn and torch.is_grad_enabled()
        return medium.with_absorption(self._replayed(path, rays) if learns else path).in_room_of(rays)

    @torch.no_grad()
    def exit_directions(self, rays: Rays) -> Float[Tensor, "R 3"]:
        """Return the unit exit direction of the main polyline of each ray; other branches are not traced."""
        return self.path_sampler.trace_main(rays, self.scene.medium).exit_directions

    @property
    def paths_learn(self) -> bool:
        """Whether paths depend on parameters that gradient descent learns."""
        parameters = [*self.scene.path_parameters(), *self.path_sampler.parameters()]
        return any(parameter.requires_grad for parameter in parameters)

    @property
    def traces_on_cpu(self) -> bool:
        """Whether batches are made on the CPU for any device: paths depend on nothing that gradient descent learns."""
        return not self.paths_learn and self.path_sampler.releases_gil(self.scene.medium)

    @torch.inference_mode()
    def render(self, rays: Rays) -> RenderedRays:
        """Render any number of rays in chunks, as in evaluation.

        Memory is bounded by the samples and activations of `chunk_size` rays plus the result.
        """
        return RenderedRays(*self._in_chunks(self._render_chunk, rays))

    @torch.no_grad()
    def radiance(self, rays: Rays) -> Float[Tensor, "R 3"]:
        """Render the radiance of any number of rays in chunks, without the other results of `render`."""
        return self._in_chunks(lambda chunk: self._render_traced(chunk, self.trace(chunk)), rays)[0]

    def map_chunks(self, task: Callable[[slice], Result], like: Tensor, size: int) -> list[Result]:
        """Call a function for chunks of rows in evaluation mode and without gradients, see `share_rows`."""
        was_training = self.training
        self.eval()
        try:
            return share_rows(task, like, size)
        finally:
            self.train(was_training)

    def _replayed(self, path: Path, rays: Rays) -> Path:
        """Replay paths with gradients, except for paths whose derivatives are too large."""
        medium = self.scene.medium
        # Other paths have many events, and their replay would take most of the time.
        steady = self.path_sampler.steady(path, medium).nonzero()[:, 0]
        return self.path_sampler.replay_rows(path, rays, medium, steady)

    def _in_chunks(self, render: Callable[[Rays], tuple[Tensor, ...]], rays: Rays) -> list[Tensor]:
        """Render `chunk_size` rays at a time, see `map_chunks`, and concatenate the results."""
        chunks = self.map_chunks(lambda rows: render(rays[rows]), rays.near, self.chunk_size)
        return [torch.cat(parts) for parts in zip(*chunks, strict=True)]

    def _render_chunk(self, rays: Rays) -> tuple[Tensor, ...]:
        path = self.trace(rays)
        exits, normals = path.main_polyline(path.exit_directions), first_normals(path, self.scene.medium)
        return *self._render_traced(rays, path), exits, normals, path.main_polyline(path.refracted)

    def _render_traced(self, rays: Rays, path: Path) -> tuple[Tensor, Tensor, Tensor]:
        """Render radiance, depth and opacity of traced rays."""
        meets = self._may_meet(rays, path)
        if meets.all():
            rendering = self.render_path(path)[-1]
            return rendering.radiance, rendering.depth, rendering.opacity
        # Most rays of an image miss the object.
        radiance, depth = torch.empty_like(rays.directions), path.main_polyline(path.far).clone()
        opacity = torch.zeros_like(depth)
        misses, rows = (~meets).nonzero()[:, 0], meets.nonzero()[:, 0]
        radiance[misses] = self.scene.background(Exits.unbent(rays[misses])).to(radiance)
        if len(rows):
            rendering = self.render_path(path.select_rays(rows))[-1]
            radiance[rows], depth[rows], opacity[rows] = (
                part.to(radiance) for part in (rendering.radiance, rendering.depth, rendering.opacity)
            )
        return radiance, depth, opacity

    def _may_meet(self, rays: Rays, path: Path) -> Bool[Tensor, "R"]:
        """Find the rays that may meet a field; the others are straight and show the background."""
        meets = torch.full((len(rays),), not self.empty_shows_background, device=rays.near.device)
        for field in self.scene.fields:
            box: Tensor | None = field.bounds  # type: ignore[assignment]
            if box is None:
                return torch.ones_like(meets)
            enter, leave = intersect_box(box, rays.origins, rays.directions)
            meets |= (enter <= leave) & (leave >= 0)
        meets[path.ray[path.refracted]] = True
        return meets
