"""A trained scene: rendering from any camera, access to its components, and modified copies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.core.progress import track
from nerfro.core.types import Exits
from nerfro.core.variants import variant
from nerfro.data.base import DataSource, Views
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import maps_of, render_view
from nerfro.evaluation.results import FULL, Region
from nerfro.evaluation.tables import Table, views_table
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.files.images import data_uri, to_8bit
from nerfro.geometry.mesh import TriangleMesh
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.changes import with_absorption, with_indices, with_normals, with_sky, without_glass, without_inside
from nerfro.viewing.surface import surface_of


class RenderedViews(NamedTuple):
    """Images of V cameras, on the CPU.

    Attributes:
        rgb: sRGB in [0, 1].
        depth: expected arc length of the content along the bent ray, world units; the end of the path in empty pixels.
        opacity: opacity of the content, from 0 to 1.
        normals: unit normals at the first intersection with the glass, towards the camera; zero where rays miss the
            glass.
        exit_directions: unit directions in which the rays leave the scene.
        radiance: linear radiance, not bounded above.
    """

    rgb: Float[Tensor, "V H W 3"]
    depth: Float[Tensor, "V H W"]
    opacity: Float[Tensor, "V H W"]
    normals: Float[Tensor, "V H W 3"]
    exit_directions: Float[Tensor, "V H W 3"]
    radiance: Float[Tensor, "V H W 3"]

    def __repr__(self) -> str:
        views, height, width, _ = self.rgb.shape
        return f"RenderedViews({views} of {width} x {height} pixels)"

    def _repr_html_(self) -> str:
        """Show the images side by side in a notebook."""
        return f'<img src="{data_uri(to_8bit(torch.cat(list(self.rgb), 1)).numpy(), "PNG")}">'


@dataclass(frozen=True)
class TrainedScene:
    """A trained model with its training data; `nerfro.load` reads the scene of a run.

    Attributes:
        renderer: renderer of the learned scene, in evaluation mode.
        source: data set.
        subdivision: rays per pixel; the default is the subdivision of the run's evaluation.
        name: name of the experiment.
        training_cameras: cameras of the training views as trained; None to take those of the data set.
    """

    renderer: Renderer
    source: DataSource
    subdivision: Subdivision = field(default_factory=Subdivision)
    name: str = ""
    training_cameras: Cameras | None = None

    def __repr__(self) -> str:
        return f"TrainedScene({self.name}, {self.renderer.scene})"

    def views(self, split: str = "test") -> Views:
        """Load the cameras, photographs and masks of a split of the data.

        Raises:
            NerfroError: the data do not exist, or lack the split.
        """
        if not self.has_data:
            raise NerfroError(
                f"the data of the run, {self.source.root}, do not exist here; give root=FOLDER. A path around the "
                "object (path=orbit) and exports need no data"
            )
        return self.source.load(split)

    @property
    def has_data(self) -> bool:
        """Whether the folder of the data exists."""
        return self.source.root.is_dir()

    def cameras(self, split: str = "test") -> Cameras:
        """Return the cameras of a split, on the device of the scene; only those of training are known without data."""
        cameras = self.training_cameras if split == "train" else None
        return (cameras or self.views(split).cameras).to(self.renderer.scene.device)

    def render(
        self,
        cameras: Cameras,
        subdivision: Subdivision | None = None,
        chunk_size: int | None = None,
        progress: bool = False,
    ) -> RenderedViews:
        """Render images of cameras, in chunks that limit the memory.

        Args:
            cameras: cameras on any device; see `nerfro.core.cameras.Cameras` for their axes.
            subdivision: rays per pixel, by default those of the run's evaluation; `Subdivision()` means one ray.
            chunk_size: rays rendered at once, by default those of the run's evaluation.
            progress: whether to show a progress bar.

        Raises:
            NerfroError: there are no cameras.
        """
        if not len(cameras):
            raise NerfroError("there are no cameras to render; select at least one view")
        scene = self if chunk_size is None else replace(self, renderer=variant(self.renderer, chunk_size=chunk_size))
        views = track("render", range(len(cameras)), disable=not progress)
        rendered = [scene._render_view(cameras, view, subdivision or self.subdivision) for view in views]
        return RenderedViews(*(torch.stack(images) for images in zip(*rendered, strict=True)))

    def evaluate(
        self, views: Views | str = "test", metrics: Sequence[str] | None = None, region: Region = FULL
    ) -> Table:
        """Render views with their given cameras, and score the images as `nerfro.evaluate` does, without files.

        Args:
            views: a split of the data, or any views, such as `scene.views("test").select([0, 1])`.
            metrics: names of metrics, such as `["psnr", "lpips"]`; by default all registered ones.
            region: `full`, or `mask` and `crop` of the object, which need masks.

        Returns:
            Table with a row for each view and a row `mean`. `table["mean", "PSNR"]` is a number, and `print(table)`
            prints Markdown.

        Raises:
            NerfroError: a metric does not exist, or the views lack its maps, or masks for the region.
        """
        scorer = ImageMetrics(metrics)
        split, views = (views, self.views(views)) if isinstance(views, str) else ("given", views)
        if region != FULL and views.masks is None:
            raise NerfroError(f"region={region} needs masks, which the {split} views lack; set region='full'")
        for name, metric in scorer.metrics.items():
            if metrics is not None and not set(metric.maps) <= set(views.maps):
                needed, available = ", ".join(metric.maps), ", ".join(views.maps) or "no maps"
                raise NerfroError(f"metric={name} needs the maps {needed}; the {split} views have {available}")
        scores, device = [], self.renderer.scene.device
        for view in track("evaluate", range(len(views))):
            rays = render_view(self.renderer, views.cameras.to(device), view, self.subdivision)
            rgb = self.renderer.scene.colour_space.to_display(rays.radiance).float().cpu()
            target, coverage = views.images[view], None if views.masks is None else views.masks[view]
            maps = maps_of(views, view, rays)
            scores.append(scorer.score(views.names[view], rgb.view(target.shape), target, coverage, maps))
        return views_table(scorer.result(scores), f"{self.name}, {split} views", region)

    def _render_view(self, cameras: Cameras, view: int, subdivision: Subdivision) -> tuple[Tensor, ...]:
        rays = render_view(self.renderer, cameras.to(self.renderer.scene.device), view, subdivision)
        colour_space = self.renderer.scene.colour_space
        rgb, radiance = colour_space.to_display(rays.radiance), colour_space.to_linear(rays.radiance)
        values = rgb, rays.depth, rays.opacity, rays.normals, rays.exit_directions, radiance
        return tuple(value.float().cpu().view(cameras.height, cameras.width, *value.shape[1:]) for value in values)

    @property
    def sky(self) -> Float[Tensor, "H 2*H 3"]:
        """Background as a lat-long image of linear radiance, z up (see `files.lat_long`), with `sky_height` rows."""
        return self.sky_of_height(self.sky_height)

    @property
    def sky_height(self) -> int:
        """Number of rows of a lat-long image as fine as the background, at least 512."""
        return max(512, 2 * self.renderer.scene.background.face_resolution)

    def sky_of_height(self, height: int) -> Float[Tensor, "H 2*H 3"]:
        """Evaluate the background as a lat-long image with a given number of rows."""
        return self.background(lat_long.directions(height).view(-1, 3)).view(height, 2 * height, 3)

    @torch.inference_mode()
    def background(self, directions: Float[Tensor, "D 3"]) -> Float[Tensor, "D 3"]:
        """Evaluate the linear background radiance in unit directions, seen from the centre of the scene."""
        scene = self.renderer.scene
        chunks = directions.to(scene.device).split(self.renderer.chunk_size)
        radiance = torch.cat([scene.background(Exits(chunk)) for chunk in chunks])
        return scene.colour_space.to_linear(radiance.float()).cpu()

    @property
    def surface(self) -> list[TriangleMesh]:
        """Surfaces on which rays bend, of each body in ascending order of priority; world units."""
        return surface_of(self.renderer.scene.medium, self.renderer.path_sampler.traces_triangles)

    @property
    def field(self) -> Field:
        """Radiance field of the finest sampling level."""
        finest: Field = self.renderer.scene.fields[-1]  # type: ignore[assignment]
        return finest

    @property
    def ior(self) -> Float[Tensor, "K"]:
        """Refractive index of each body in ascending order of priority; empty without bodies."""
        return self.renderer.scene.medium.indices.cpu()

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Corners of the box around the glass, or without glass around the content; world units."""
        box = self.renderer.scene.medium.content_box.float().cpu()
        if (box[1] > box[0]).all():
            return box
        content = self.renderer.scene.space.content
        if content is None:
            raise NerfroError(
                "the position of the object is unknown, because the run has neither glass nor content.box_min; "
                "train with content.box_min and content.box_max"
            )
        return content.cpu()

    def with_(
        self,
        sky: str | Path | Float[Tensor, "H W 3"] | None = None,
        ior: float | Sequence[float] | Tensor | None = None,
        absorption: Sequence[float] | Tensor | None = None,
        glass: bool = True,
        inside: bool = True,
        normals: bool = False,
    ) -> TrainedScene:
        """Return a copy with some components replaced; the copy shares all other components.

        Args:
            sky: lat-long image of linear radiance, or a file (.hdr, .exr, .png, .jpg), that replaces the background.
            ior: refractive index of the first body, or of each body.
            absorption: absorption of red, green and blue in the first body [3], or in each body [K, 3], per world unit.
            glass: False removes the glass, so that all rays are straight.
            inside: False removes the content of the glass.
            normals: True replaces the radiance of the content by its normals, from the gradient of the density, and the
                background by black. `normalize(scene.with_(normals=True).render(cameras).radiance, dim=-1)` are unit
                vectors.

        Raises:
            NerfroError: the model lacks the component, or a value is invalid.
        """
        renderer = self.renderer
        if sky is not None:
            image = sky if isinstance(sky, Tensor) else lat_long.load_lat_long(user_path(sky))
            renderer = with_sky(renderer, image)
        if ior is not None:
            renderer = with_indices(renderer, torch.as_tensor(ior))
        if absorption is not None:
            renderer = with_absorption(renderer, torch.as_tensor(absorption))
        if not glass:
            renderer = without_glass(renderer)
        if not inside:
            renderer = without_inside(renderer)
        if normals:
            renderer = with_normals(renderer)
        return replace(self, renderer=renderer)
