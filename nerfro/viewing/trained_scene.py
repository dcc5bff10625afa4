"""A trained scene: rendering from any camera, access to its components, and changed copies.

Changes are another sky, other indices or absorption, no glass, nothing inside, or normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.backgrounds.base import ConstantBackground
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.light import ColourSpace, to_srgb
from nerfro.core.paths import user_path
from nerfro.core.progress import track
from nerfro.core.types import Exits, FieldValues, Samples
from nerfro.core.variants import variant
from nerfro.data.base import DataSource, Views
from nerfro.evaluation.render_view import maps_of, render_view
from nerfro.evaluation.results import FULL, Region
from nerfro.evaluation.scoring import ImageMetrics
from nerfro.evaluation.tables import Table, views_table
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.files.images import data_uri, to_8bit
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.base import Vacuum
from nerfro.rendering import Renderer, Scene
from nerfro.samplers.base import Straight
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.surface import surface_of


class EmptyField(Field):
    """Radiance field of density zero."""

    def forward(self, samples: Samples) -> FieldValues:
        return FieldValues(torch.zeros_like(samples.s), torch.zeros_like(samples.positions))


class NormalsField(Field):
    """Radiance field whose radiance is the normal of another field, the unit vector against its density gradient.

    Args:
        field: the field.
    """

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field = field

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return self.field.bounds

    def forward(self, samples: Samples) -> FieldValues:
        density = self.field(samples).density
        normals, solid = torch.zeros_like(samples.positions), density > 0
        if solid.any():
            with torch.inference_mode(False), torch.enable_grad():  # renderings have no gradients otherwise
                positions = samples.positions[solid].clone().requires_grad_()
                # The logarithm gives points of all densities the same weight; the gradient of a field leaves out points
                # of small weight.
                density_there = self.field.density(positions)
                logarithm = density_there.clamp(min=torch.finfo(density_there.dtype).tiny).log()
                (gradient,) = torch.autograd.grad(logarithm.sum(), positions)
            normals[solid] = -nn.functional.normalize(gradient, dim=-1).to(normals)
        return FieldValues(density, normals)


def with_changed_scene(renderer: Renderer, **changes: object) -> Renderer:
    """Copy a renderer with some components of its scene replaced; the copy shares all other components."""
    return variant(renderer, scene=variant(renderer.scene, **changes))


def with_sky(renderer: Renderer, radiance: Float[Tensor, "H 2*H 3"]) -> Renderer:
    """Replace the background by a lat-long image of linear radiance, z up."""
    if radiance.ndim != 3 or radiance.shape[1:] != (2 * len(radiance), 3):
        raise NerfroError(f"a sky of shape {list(radiance.shape)} is no lat-long image; give one of [H, 2 H, 3]")
    radiance = radiance.float()
    if not torch.isfinite(radiance).all() or (radiance < 0).any():
        raise NerfroError("the radiance of a sky must be finite and not negative; correct its values")
    # A face of the cube spans a quarter of the width of the image.
    sky, scene = EnvironmentMap([max(1, radiance.shape[1] // 4)]), renderer.scene
    sky.set_lat_long(to_srgb(radiance) if scene.colour_space is ColourSpace.SRGB else radiance)
    return with_changed_scene(renderer, background=sky.to(scene.device).eval())


def with_indices(renderer: Renderer, ior: Float[Tensor, "*K"]) -> Renderer:
    """Replace the refractive indices: one for each body, or one number for the first body."""
    medium = renderer.scene.medium
    return with_changed_scene(renderer, medium=medium.with_indices(_of_bodies(ior, medium.indices, "ior")))


def with_absorption(renderer: Renderer, absorption: Float[Tensor, "*K 3"]) -> Renderer:
    """Replace the absorption coefficients: three for each body, or three for the first body."""
    medium = renderer.scene.medium
    coefficients = absorption_of(renderer.scene)
    if medium.bodies is not None:
        absorption = _of_bodies(absorption, coefficients, "absorption").to(renderer.scene.device)
    return with_changed_scene(renderer, medium=medium.with_absorption_coefficients(absorption))


def absorption_of(scene: Scene) -> Float[Tensor, "K 3"]:
    """Return the absorption of red, green and blue in each body, per world unit, on the CPU."""
    absorption = scene.medium.absorption
    return torch.zeros(len(scene.medium.indices), 3) if absorption is None else absorption.detach().float().cpu()


def without_glass(renderer: Renderer) -> Renderer:
    """Replace the medium by a vacuum, in which rays are straight."""
    vacuum = Vacuum().to(renderer.scene.device)
    return variant(with_changed_scene(renderer, medium=vacuum), path_sampler=Straight())


def without_inside(renderer: Renderer) -> Renderer:
    """Replace the radiance fields by empty ones, so that only glass and background remain."""
    return with_changed_scene(renderer, fields=nn.ModuleList(EmptyField() for _ in renderer.scene.fields))


def with_normals(renderer: Renderer) -> Renderer:
    """Show normals of the content as linear radiance, before black and without absorption."""
    scene, colours = renderer.scene, ColourSpace.LINEAR
    if scene.medium.absorption is not None:
        renderer = with_absorption(renderer, torch.zeros(len(scene.medium.indices), 3))
    fields = nn.ModuleList(NormalsField(field) for field in scene.fields).eval()  # type: ignore[arg-type]
    black = ConstantBackground().to(scene.device)
    return with_changed_scene(renderer, fields=fields, background=black, colour_space=colours)


def _of_bodies(values: Tensor, current: Tensor, name: str) -> Tensor:
    """Complete values that are given for each body, or for the first body alone, to values for all bodies."""
    values = values.to(current)
    if not len(current):
        raise NerfroError(f"{name} cannot be set: the model has no bodies on which rays bend; leave {name} out")
    if values.shape == current.shape[1:]:
        values = torch.cat([values[None], current[1:]])
    wanted = "positive numbers" if name == "ior" else "numbers that are not negative"
    allowed = values > 0 if name == "ior" else values >= 0
    if values.shape != current.shape or not (torch.isfinite(values) & allowed).all():
        raise NerfroError(f"{name}={values.tolist()} is not allowed; give {list(current.shape)} {wanted}")
    return values


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
