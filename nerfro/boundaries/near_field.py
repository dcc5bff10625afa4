"""Surroundings at finite distance: a radiance field in contracted space, seen along the lines on which light leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.allowed import Positive, corners_of_box
from nerfro.boundaries.base import Boundary
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.interpolation import intersect_box
from nerfro.registry import register
from nerfro.rendering import volume_weights
from nerfro.samplers.density_grid import DensityGridSampler
from nerfro.types import Exits, Path

# Of the polyline by which the curve that a line becomes in contracted space is measured.
_NUM_CHORDS = 64

# Contraction maps all of space into a ball of this radius (mip-NeRF 360, Eqn. 10).
_CONTRACTED = 2.0


@register("boundary", "near_field")
class NearField(Boundary):
    """Hash grid of all that is outside the content's box, rendered along each ray from where it leaves the box.

    A sky has one colour for each direction; a room, in which rays of equal direction end on different things, has not.
    Space is contracted into a ball of radius 2 (mip-NeRF 360, Eqn. 10), with the ball around the box left as it is. A
    line becomes a curve there, a path like any other: it is sampled and rendered in contracted length. What light is
    left at infinity has the colour of the farthest sample. Rays that miss the box are seen from their near end on.

    Asked without a place, only by direction, it is seen from the middle of the box.

    Args:
        box_min, box_max: opposite corners of the content's bounds, world units.
        radius: of the ball around the box's middle that is left as it is, world units; none takes the box's diagonal.
            Details are finest there and coarser in proportion to the distance beyond; best as far as the cameras.
        num_samples: on each ray.
        num_bins: places at which the remembered density is asked, see `sampler/points=density_grid`.
        grid_resolution: cells of that memory along each side.
        num_levels, base_resolution, finest_resolution, log2_table_size, width, direction_bands, initial_depth,
            precision: of the field over the whole ball, see `field=hash_grid`. Light that meets something at once
            learns depths sooner than light that begins at infinity.
    """

    box: Float[Tensor, "2 3"]

    def __init__(
        self,
        box_min: list[float] = (-1.0, -1.0, -1.0),  # type: ignore[assignment]
        box_max: list[float] = (1.0, 1.0, 1.0),  # type: ignore[assignment]
        radius: Positive | None = None,
        num_samples: int = 32,
        num_bins: int = 96,
        grid_resolution: int = 64,
        num_levels: int = 12,
        base_resolution: int = 16,
        finest_resolution: int = 512,
        log2_table_size: int = 17,
        width: int = 64,
        direction_bands: int = 1,
        initial_depth: float = 3.0,
        precision: Literal["bfloat16", "float32"] = "bfloat16",
    ) -> None:
        super().__init__()
        self.register_buffer("box", torch.from_numpy(corners_of_box(box_min, box_max)).float(), persistent=False)
        self.radius = float((self.box[1] - self.box[0]).norm()) if radius is None else radius
        low, high = [-_CONTRACTED] * 3, [_CONTRACTED] * 3
        self.field = HashGridField(
            low, high, num_levels, base_resolution, finest_resolution, log2_table_size, width, direction_bands,
            initial_depth, precision,
        )  # fmt: skip
        self.sampler = DensityGridSampler(num_samples, num_bins, low, high, grid_resolution)

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        directions = exits.directions.reshape(-1, 3)
        if exits.positions is None:
            starts = self.box.mean(0).expand_as(directions)
        else:
            starts = exits.positions.reshape(-1, 3)
            # A parallel face is far away, not at infinity, where gradients are no numbers.
            enter, leave = intersect_box(self.box, starts, torch.where(directions == 0, 1e-20, directions))
            through = (enter < leave) & (leave > 0)
            starts = starts + torch.where(through, leave, 0.0)[:, None] * directions
        return self._render(starts, directions, exits.ray).view(exits.directions.shape)

    def after_step(self, step: int) -> None:
        self.sampler.after_step(step, [self.field])

    def _render(
        self, starts: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"], ray: Int[Tensor, "P"] | None = None
    ) -> Float[Tensor, "P 3"]:
        offsets = (starts - self.box.mean(0)) / self.radius
        path = contracted_lines(offsets, directions, ray)
        samples = self.sampler(path, None)
        # Chords serve to measure lengths. Places lie on the curve, or lines that meet in the world would not meet here;
        # and colour depends on the direction in the world.
        samples = replace(
            samples,
            positions=curve(offsets, directions, _share(path, samples.s)),
            directions=directions[:, None].expand_as(samples.positions),
        )
        radiance = self.field(samples)
        density, rgb = radiance.density.to(starts.dtype), radiance.rgb.to(starts.dtype)
        weights, left = volume_weights(density, samples.deltas)
        return (weights[..., None] * rgb).sum(-2) + left[:, None] * rgb[:, -1]


def contracted_lines(
    offsets: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"], ray: Int[Tensor, "P"] | None = None
) -> Path:
    """Lines from `offsets` to infinity as polylines in contracted space, with lengths measured there."""
    share = torch.linspace(0, 1, _NUM_CHORDS + 1, device=offsets.device).expand(len(offsets), -1)
    vertices = curve(offsets, directions, share)
    chords = vertices.diff(dim=1)
    lengths = chords.norm(dim=-1)
    tangents = chords / lengths.clamp(min=1e-9)[..., None]
    s = torch.cat([torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)], dim=1)
    nothing = torch.zeros(len(offsets), device=offsets.device)
    tangents = torch.cat([tangents, tangents[:, -1:]], 1)
    return Path(vertices, tangents, s, directions, nothing.bool(), nothing, ray)  # type: ignore[arg-type]


def curve(
    offsets: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], share: Float[Tensor, "R N"]
) -> Float[Tensor, "R N 3"]:
    """Contracted places on lines, from `offsets` (share 0) to infinity (share 1).

    Shares are dense where the line passes the origin: v in (-1, 1), which they divide evenly, is the distance
    scale * v / (1 - |v|) from the place that is nearest to it.
    """
    passing = -(offsets * directions).sum(-1, keepdim=True)
    scale = (offsets + passing * directions).norm(dim=-1, keepdim=True).clamp(min=1)
    first = -passing / (scale + passing.abs())
    v = (first + share * (1 - first)).clamp(max=1 - 1e-6)
    distance = passing + scale * v / (1 - v.abs())
    return contract(offsets[:, None] + distance[..., None] * directions[:, None])


def _share(path: Path, s: Float[Tensor, "R N"]) -> Float[Tensor, "R N"]:
    """Shares of the curve at lengths of the polyline."""
    chord = (torch.searchsorted(path.s, s.contiguous(), right=True) - 1).clamp(0, _NUM_CHORDS - 1)
    start, end = path.s.gather(1, chord), path.s.gather(1, chord + 1)
    return (chord + (s - start) / (end - start).clamp(min=1e-9)) / _NUM_CHORDS


def contract(x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """mip-NeRF 360's contraction: (2 - 1 / |x|) x / |x| outside the unit ball, x inside."""
    norm = x.norm(dim=-1, keepdim=True).clamp(min=1)
    return (2 - 1 / norm) * x / norm
