"""A trained scene: render it from anywhere, look at its parts, and change them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from nerfro.cameras import Cameras
from nerfro.data.base import DataSource, Views
from nerfro.errors import NerfroError
from nerfro.evaluation.render_view import render_view
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.geometry.mesh import TriangleMesh
from nerfro.models.base import NerfModel
from nerfro.paths import user_path
from nerfro.subdivision import Subdivision
from nerfro.types import Exits
from nerfro.variants import variant
from nerfro.viewing.changes import with_absorption, with_indices, with_sky, without_glass, without_inside
from nerfro.viewing.surface import surface_of

# Rows of the sky that `Scene.sky` is drawn with: the default environment map's finest texels.
SKY_HEIGHT = 512


class RenderedViews(NamedTuple):
    """Pictures of V cameras, on the CPU. It unpacks in this order: `rgb, depth, opacity, normals, exits, radiance`."""

    rgb: Float[Tensor, "V H W 3"]  # sRGB in [0, 1]
    # Expected arc length along the bent ray of what is inside, world units; the path's end where nothing is.
    depth: Float[Tensor, "V H W"]
    opacity: Float[Tensor, "V H W"]  # of what is inside, 0 to 1
    normals: Float[Tensor, "V H W 3"]  # of the surface where it is first met, towards the camera; zero beside the glass
    exit_directions: Float[Tensor, "V H W 3"]  # unit directions in which rays leave for the sky
    radiance: Float[Tensor, "V H W 3"]  # linear, unbounded above


@dataclass(frozen=True)
class Scene:
    """A trained model with the data that it was trained on; `nerfro.load` makes one of a run.

    Attributes:
        model: the radiance field, glass and sky, in evaluation.
        source: the data set.
        subdivision: rays a pixel, as the run was evaluated.
        name: of the experiment.
        content: corners of the box outside of which the field holds nothing, world units, where it has one.
    """

    model: NerfModel
    source: DataSource
    subdivision: Subdivision = field(default_factory=Subdivision)
    name: str = ""
    content: Float[Tensor, "2 3"] | None = None

    def views(self, split: str = "test") -> Views:
        """Cameras, photographs and masks of a split of the data."""
        return self.source.load(split)

    def cameras(self, split: str = "test") -> Cameras:
        """The cameras of a split of the data, on the scene's device."""
        return self.views(split).cameras.to(self.model.device)

    def render(
        self,
        cameras: Cameras,
        subdivision: Subdivision | None = None,
        chunk_size: int | None = None,
        progress: bool = False,
    ) -> RenderedViews:
        """Render each camera, in chunks that bound the memory.

        Args:
            cameras: on any device; see `nerfro.cameras.Cameras` for their axes.
            subdivision: rays a pixel, as the run was evaluated by default; `Subdivision()` gives each pixel one.
            chunk_size: rays rendered at once, as the run was evaluated by default.
            progress: whether to show a bar with the time that is left.
        """
        scene = self if chunk_size is None else replace(self, model=variant(self.model, chunk_size=chunk_size))
        views = tqdm(range(len(cameras)), unit="view", desc="render", disable=not progress, dynamic_ncols=True)
        rendered = [scene._render_view(cameras, view, subdivision or self.subdivision) for view in views]
        return RenderedViews(*(torch.stack(parts) for parts in zip(*rendered, strict=True)))

    def _render_view(self, cameras: Cameras, view: int, subdivision: Subdivision) -> tuple[Tensor, ...]:
        found = render_view(self.model, cameras.to(self.model.device), view, subdivision)
        rgb = self.model.photographed(found.radiance)
        radiance = self.model.linear(found.radiance)
        values = rgb, found.depth, found.opacity, found.normals, found.exit_directions, radiance
        return tuple(value.float().cpu().view(cameras.height, cameras.width, *value.shape[1:]) for value in values)

    @property
    def sky(self) -> Float[Tensor, "512 1024 3"]:
        """What is seen beyond the volume, from its middle: linear radiance, lat-long, z up (see `files.lat_long`)."""
        return self.sky_of_height(SKY_HEIGHT)

    def sky_of_height(self, height: int) -> Float[Tensor, "H 2*H 3"]:
        """`sky` with another number of rows."""
        return self.seen_beyond(lat_long.directions(height).view(-1, 3)).view(height, 2 * height, 3)

    @torch.inference_mode()
    def seen_beyond(self, directions: Float[Tensor, "D 3"]) -> Float[Tensor, "D 3"]:
        """Linear radiance from beyond the volume in unit directions, as seen from its middle; on the CPU."""
        model = self.model
        parts = directions.to(model.device).split(model.chunk_size)
        return model.linear(torch.cat([model.boundary(Exits(part)) for part in parts]).float()).cpu()

    @property
    def surface(self) -> list[TriangleMesh]:
        """The surfaces on which rays bend, the outer body's first; world units."""
        return surface_of(self.model.medium, getattr(self.model.path_sampler, "interface", "sdf") == "mesh")

    @property
    def field(self) -> Field:
        """The radiance field that the finest sampling level asks."""
        finest: Field = self.model.fields[-1]  # type: ignore[assignment]
        return finest

    @property
    def ior(self) -> Float[Tensor, "K"]:
        """Refractive index of each body, the outer one's first; none without bodies."""
        return self.model.medium.indices.cpu()

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Corners of the box around the glass, or around all that the field holds where there is no glass."""
        box = self.model.medium.content_box.float().cpu()
        if (box[1] > box[0]).all():
            return box
        if self.content is None:
            raise NerfroError("it is not known where the object is: the run has neither glass nor content.box_min")
        return self.content

    def with_(
        self,
        sky: str | Path | Float[Tensor, "H W 3"] | None = None,
        ior: float | Sequence[float] | Tensor | None = None,
        absorption: Sequence[float] | Tensor | None = None,
        glass: bool = True,
        inside: bool = True,
    ) -> Scene:
        """The scene with some parts changed; it shares all others with this one, which stays as it is.

        Args:
            sky: lat-long picture of linear radiance, or its file (.hdr, .exr, .png, .jpg), instead of the sky.
            ior: index of the outer body, or of each.
            absorption: of red, green and blue in the outer body, or in each [K, 3], per world unit.
            glass: False takes the glass away: all rays are straight.
            inside: False takes away what is inside.

        Raises:
            NerfroError: the model has no such part.
        """
        model = self.model
        if sky is not None:
            picture = sky if isinstance(sky, Tensor) else lat_long.load_lat_long(user_path(sky))
            model = with_sky(model, picture)
        if ior is not None:
            model = with_indices(model, torch.as_tensor(ior))
        if absorption is not None:
            model = with_absorption(model, torch.as_tensor(absorption))
        if not glass:
            model = without_glass(model)
        if not inside:
            model = without_inside(model)
        return replace(self, model=model)
