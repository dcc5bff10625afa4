"""A multi-resolution hash grid with two small MLPs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.types import FieldValues, Samples
from nerfro.fields import hash_encoding
from nerfro.fields import spherical_harmonics as harmonics
from nerfro.fields.base import Field
from nerfro.fields.networks import radiance
from nerfro.fields.observed_space import NUM_CELLS, observed_cells
from nerfro.fields.selection import evaluate_selected, inside_box
from nerfro.geometry.box import corners_of_box
from nerfro.geometry.contraction import contract, contracted_box, contraction_scale
from nerfro.kernels.available import fast_bfloat16
from nerfro.registry.allowed import Depth, Positive, Width
from nerfro.registry.registration import register

# Number of features that the density network passes to the colour network.
_GEOMETRY_FEATURES = 16

# The exponential is clamped at e^15 times the initial density, in value and gradient.
_MAX_EXPONENT = 15.0

# Cells of the coarsest level along the box's longest side, as in Instant-NGP.
_COARSEST_RESOLUTION = 16


@register("field", "hash_grid")
class HashGridField(Field):
    """Hash encoding with a density MLP and a view-dependent colour MLP (Instant-NGP, sections 3 and 5.4).

    Density is exp(raw), scaled so that a ray across the box initially has an optical depth of about `initial_depth`.
    The field is empty outside the box, and samples there are not evaluated. With a `radius`, the field covers all of
    space, contracted outside a ball (mip-NeRF 360, Eqn. 10), and the box is the cube around contracted space.

    Args:
        box_min, box_max: opposite corners of the content's bounds, world units.
        radius: radius of a ball around the centre of the box, world units, within which the resolution is finest.
            Outside, cells grow with the distance. None if the scene is empty outside the box.
        num_levels: number of levels of the encoding, with 2 features each.
        finest_resolution: number of cells of the finest level along the longest side of the box.
        log2_table_size: base-2 logarithm of the largest number of entries of a level.
        width: width of the hidden layers.
        direction_bands: number of bands of spherical harmonics of the direction; 1 for view-independent colour.
        initial_depth: optical depth of the untrained field along the longest side of the box.
        shortcut: whether to add three features of the density network to the colour before the sigmoid. In images of
            mostly one colour, all units of the colour network can become inactive where another colour is needed, and
            without the shortcut no gradient would reach these places.
        precision: number format of the MLPs' matrix products. None selects bfloat16 if the machine has units for
            bfloat16, else float32.
    """

    box_min: Float[Tensor, "3"]
    box_max: Float[Tensor, "3"]
    observed: Bool[Tensor, "cells cells cells"] | None

    def __init__(
        self,
        box_min: Sequence[float] = (-1.0, -1.0, -1.0),
        box_max: Sequence[float] = (1.0, 1.0, 1.0),
        radius: Positive | None = None,
        num_levels: Depth = 12,
        finest_resolution: Annotated[int, Ge(_COARSEST_RESOLUTION)] = 256,
        log2_table_size: Annotated[int, Ge(4), Le(24)] = 15,
        width: Width = 64,
        direction_bands: Annotated[int, Ge(1), Le(harmonics.MAX_BANDS)] = 4,
        initial_depth: Positive = 0.1,
        shortcut: bool = True,
        precision: Literal["bfloat16", "float32"] | None = None,
    ) -> None:
        super().__init__()
        box = torch.from_numpy(corners_of_box(box_min, box_max))
        self.radius, box = radius, box if radius is None else contracted_box(box, radius)
        self.register_buffer("box_min", box[0].float(), persistent=False)
        self.register_buffer("box_max", box[1].float(), persistent=False)
        self.side = float((box[1] - box[0]).max())
        observed = None if radius is None else torch.ones(NUM_CELLS, NUM_CELLS, NUM_CELLS, dtype=torch.bool)
        self.register_buffer("observed", observed)
        self.initial_density = initial_depth / self.side
        self.direction_bands, self.shortcut, self.precision = direction_bands, shortcut, precision
        self.levels = hash_encoding.grid_levels(num_levels, _COARSEST_RESOLUTION, finest_resolution, log2_table_size)
        self.table = nn.Parameter(torch.empty(self.levels.num_entries, hash_encoding.NUM_FEATURES))
        nn.init.uniform_(self.table, -1e-4, 1e-4)
        num_harmonics = harmonics.spherical_harmonics(torch.zeros(1, 3), direction_bands).shape[-1]
        self.density_mlp = _mlp(hash_encoding.NUM_FEATURES * num_levels, width, 1, _GEOMETRY_FEATURES)
        self.colour_mlp = _mlp(_GEOMETRY_FEATURES + num_harmonics, width, 2, 3)

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return torch.stack([self.box_min, self.box_max]) if self.radius is None else None

    def forward(self, samples: Samples) -> FieldValues:
        if self.radius is None:
            return evaluate_selected(self.decode, samples, inside_box(samples.positions, self.box_min, self.box_max))
        # In training, about 92 % of the samples are occupied, and their selection costs more than it saves.
        return evaluate_selected(self._decode_world, replace(samples, occupied=None) if self.training else samples)

    def _decode_world(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density per world unit and colour at positions in world space that is contracted."""
        assert self.radius is not None
        places = contract(positions, self.centre, self.radius)
        density, colour = self.decode(places, directions)
        return self._world_density(density, positions, places), colour

    def decode(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density (per unit of contracted length) and colour at contracted positions."""
        geometry = self.apply_mlp(self.density_mlp, self.encode(positions))
        raw = self.apply_mlp(self.colour_mlp, geometry, self.encode_directions(directions))
        if self.shortcut:
            raw = raw + geometry[:, 1:4]
        return self._to_density(geometry), radiance(raw)

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        if self.radius is None:
            density = self._to_density(self.apply_mlp(self.density_mlp, self.encode(positions)))
            return torch.where(inside_box(positions, self.box_min, self.box_max), density, 0.0)
        places = contract(positions, self.centre, self.radius)
        density = self._to_density(self.apply_mlp(self.density_mlp, self.encode(places)))
        return self._world_density(density, positions, places)

    def begin(self, cameras: Cameras) -> None:
        if self.radius is not None:
            self.observed = observed_cells(cameras, self.centre, self.radius)

    def _world_density(
        self, density: Float[Tensor, " points"], positions: Float[Tensor, "points 3"], places: Float[Tensor, "points 3"]
    ) -> Float[Tensor, " points"]:
        """Convert the density at contracted places to one per world unit, which is zero in cells not observed."""
        assert self.observed is not None
        assert self.radius is not None
        cells = self.observed.shape[0]
        x, y, z = ((places.detach() - self.box_min) / self.side * cells).long().clamp(0, cells - 1).unbind(-1)
        density = density * self.observed.view(-1)[(x * cells + y) * cells + z]
        return density * contraction_scale(positions, self.centre, self.radius)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return 0.5 * (self.box_min + self.box_max)

    def _to_density(self, geometry: Float[Tensor, "points G"]) -> Float[Tensor, " points"]:
        return self.initial_density * torch.exp(geometry[:, 0].float().clamp(max=_MAX_EXPONENT))

    def encode(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points F"]:
        """Encode positions in single precision, on the CPU by a compiled kernel."""
        unit = (positions - self.box_min) / self.side
        if unit.device.type == "cpu":
            from nerfro.fields.hash_encoding_cpu import hash_encode  # compiled, hence imported late
        else:
            hash_encode = hash_encoding.hash_encode
        return hash_encode(unit, self.table, self.levels)

    def encode_directions(self, directions: Float[Tensor, "points 3"]) -> Float[Tensor, "points bases"]:
        """Encode directions by spherical harmonics, on the CPU by a compiled kernel."""
        if directions.device.type == "cpu":
            from nerfro.fields.spherical_harmonics_cpu import spherical_harmonics
        else:
            spherical_harmonics = harmonics.spherical_harmonics
        return spherical_harmonics(directions, self.direction_bands)

    def apply_mlp(self, mlp: nn.Sequential, *inputs: Float[Tensor, "points _"]) -> Float[Tensor, "points O"]:
        """Apply an MLP to concatenated inputs in the precision of the field, on the CPU by `relu_mlp`."""
        device = inputs[0].device.type
        rounds = fast_bfloat16(device) if self.precision is None else self.precision == "bfloat16"
        if device == "cpu":
            from nerfro.fields.relu_mlp import relu_mlp

            weights = [layer.weight for layer in mlp if isinstance(layer, nn.Linear)]
            return relu_mlp(list(inputs), weights, torch.bfloat16 if rounds else torch.float32)
        with torch.autocast(device, torch.bfloat16, enabled=rounds):
            return mlp(torch.cat([part.to(inputs[0].dtype) for part in inputs], dim=-1))


def _mlp(num_inputs: int, width: int, num_hidden: int, num_outputs: int) -> nn.Sequential:
    """Create ReLU layers without biases and with Glorot-uniform weights."""
    widths = [num_inputs, *[width] * num_hidden, num_outputs]
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        linear = nn.Linear(inputs, outputs, bias=False)
        nn.init.xavier_uniform_(linear.weight)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])
