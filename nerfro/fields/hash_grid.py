"""A multi-resolution hash grid with two small MLPs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float
from omegaconf import DictConfig
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.types import FieldValues, Samples
from nerfro.data.base import Views
from nerfro.fields import hash_encoding
from nerfro.fields.base import Field, evaluate_selected, radiance
from nerfro.fields.relu_mlp import ReluMLP
from nerfro.fields.spherical_harmonics import MAX_BANDS, spherical_harmonics
from nerfro.geometry.space import Space
from nerfro.registry.allowed import Depth, Positive, Width
from nerfro.registry.registration import register

# Number of features that the density network passes to the colour network.
_GEOMETRY_FEATURES = 16


# Cells of the coarsest level along the box's longest side, as in Instant-NGP.
_COARSEST_RESOLUTION = 16

# Bounds of the number of cells that is derived from the cameras; memory limits the upper one.
_MIN_CELLS, _MAX_CELLS = 128, 4096


@register("field", "hash_grid")
class HashGridField(Field):
    """Hash encoding with a density MLP and a view-dependent colour MLP (Instant-NGP, sections 3 and 5.4).

    Density is exp(raw), scaled so that a ray across the box initially has an optical depth of about `initial_depth`.
    The field is empty outside a box, and samples there are not evaluated. In contracted space, the field covers all of
    space, and cells grow with the distance.

    Args:
        space: space that the field covers; it has a box.
        num_levels: number of levels of the encoding, with 2 features each.
        finest_resolution: number of cells of the finest level along the longest side of the box. None derives it from
            the cameras, so that a cell at the centre is half a pixel wide.
        log2_table_size: base-2 logarithm of the largest number of entries of a level.
        width: width of the hidden layers.
        direction_bands: number of bands of spherical harmonics of the direction; 1 for view-independent colour.
        initial_depth: optical depth of the untrained field along the longest side of the box.
        shortcut: whether to add three features of the density network to the colour before the sigmoid. In images of
            mostly one colour, all units of the colour network can become inactive where another colour is needed, and
            without the shortcut no gradient would reach these places.
        unbounded: whether radiance may exceed 1, for bright content in photographs in linear light.
        precision: number format of the MLPs' matrix products. None selects bfloat16 if the machine has units for
            bfloat16, else float32.
    """

    needs_box = True
    observed: Bool[Tensor, "cells cells cells"] | None

    def __init__(
        self,
        space: Space,
        num_levels: Depth = 12,
        finest_resolution: Annotated[int, Ge(_COARSEST_RESOLUTION)] | None = 256,
        log2_table_size: Annotated[int, Ge(4), Le(24)] = 15,
        width: Width = 64,
        direction_bands: Annotated[int, Ge(1), Le(MAX_BANDS)] = 4,
        initial_depth: Positive = 0.1,
        shortcut: bool = True,
        unbounded: bool = False,
        precision: Literal["bfloat16", "float32"] | None = None,
    ) -> None:
        super().__init__()
        self.space = space
        self.register_buffer("observed", space.observed())
        self.initial_density = initial_depth / space.side
        self.direction_bands, self.shortcut, self.unbounded = direction_bands, shortcut, unbounded
        finest_resolution = 256 if finest_resolution is None else finest_resolution
        self.levels = hash_encoding.grid_levels(num_levels, _COARSEST_RESOLUTION, finest_resolution, log2_table_size)
        self.table = nn.Parameter(torch.empty(self.levels.num_entries, hash_encoding.NUM_FEATURES))
        nn.init.uniform_(self.table, -1e-4, 1e-4)
        num_features = hash_encoding.NUM_FEATURES * num_levels
        self.density_mlp = ReluMLP(num_features, width, _GEOMETRY_FEATURES, precision=precision)
        self.colour_mlp = ReluMLP(_GEOMETRY_FEATURES + direction_bands**2, width, width, 3, precision=precision)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        cameras = views.cameras
        distances = (cameras.camera_to_world[:, :, 3].double() - space.centre).norm(dim=-1)
        pixel = float((distances / cameras.fx.double()).quantile(0.5))
        # A detail of one pixel needs two cells of the finest grid along each side (sampling theorem).
        cells = math.ceil(2 * space.side / pixel)
        return {"finest_resolution": min(max(cells, _MIN_CELLS), _MAX_CELLS)}

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return self.space.bounds

    def forward(self, samples: Samples) -> FieldValues:
        inside = self.space.inside(samples.positions)
        if inside is None and self.training:
            # About 92 % of the samples are occupied, and their selection costs more than it saves.
            samples = replace(samples, occupied=None)
        return evaluate_selected(self._decode_world, samples, inside)

    def _decode_world(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density per world unit and colour at positions in the space."""
        contracted = self.space.contract(positions)
        density, colour = self.decode(contracted, directions)
        return self._world_density(density, positions, contracted), colour

    def decode(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density (per unit of contracted length) and colour at contracted positions."""
        geometry = self.density_mlp(self.encode(positions))
        raw = self.colour_mlp(geometry, spherical_harmonics(directions, self.direction_bands))
        if self.shortcut:
            raw = raw + geometry[:, 1:4]
        return self._to_density(geometry), radiance(raw, self.unbounded)

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        contracted = self.space.contract(positions)
        density = self._to_density(self.density_mlp(self.encode(contracted)))
        density, inside = self._world_density(density, positions, contracted), self.space.inside(positions)
        return density if inside is None else torch.where(inside, density, 0.0)

    def begin(self, cameras: Cameras) -> None:
        self.observed = self.space.observed(cameras)

    def _world_density(
        self,
        density: Float[Tensor, " points"],
        positions: Float[Tensor, "points 3"],
        contracted: Float[Tensor, "points 3"],
    ) -> Float[Tensor, " points"]:
        """Convert the density at contracted positions to one per world unit, which is zero in cells not observed."""
        if self.observed is not None:
            cells = self.observed.shape[0]
            x, y, z = (self._unit(contracted.detach()) * cells).long().clamp(0, cells - 1).unbind(-1)
            density = density * self.observed.view(-1)[(x * cells + y) * cells + z]
        return density * self.space.scale(positions)

    def _unit(self, contracted: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Map contracted positions to the unit cube of the encoding."""
        return (contracted - self.space.box[0]) / self.space.side

    def _to_density(self, geometry: Float[Tensor, "points G"]) -> Float[Tensor, " points"]:
        # The exponential is clamped at e^15 times the initial density, in value and gradient.
        return self.initial_density * torch.exp(geometry[:, 0].float().clamp(max=15.0))

    def encode(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points F"]:
        """Encode contracted positions in single precision."""
        levels = self.levels
        return hash_encoding.hash_encode(self._unit(positions), self.table, levels.resolutions, levels.sizes)
