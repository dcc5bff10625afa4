"""A vessel that contains a liquid: nested bodies made from one outer surface and a few lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.variants import variant
from nerfro.geometry.mesh import local_origin
from nerfro.kernels.available import require_bytes
from nerfro.media.base import Medium
from nerfro.media.distance_grid import DistanceGrid
from nerfro.media.grid_box import BYTES_PER_VERTEX, grid_box
from nerfro.media.lids import find_lid
from nerfro.media.material import Learns, Material, materials_of
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.surface import Grid, MeshSurface, cached_distances, direction
from nerfro.registry.allowed import Coordinate, NotNegative, Positive, Resolution
from nerfro.registry.registration import register


@register("medium", "sdf_vessel")
class SdfVessel(SdfGrid):
    """A wall of glass around a cavity that contains a liquid up to a level, and air above the liquid.

    The bodies are nested. The outer body is the wall. The cavity contains air, and is the part of the outer body deeper
    than the wall and above the foot. The liquid is the part of the cavity below the level. Liquid therefore touches
    glass without a gap. A vessel without a level is full and has no air. The wall may be much thinner than a voxel,
    because each of its surfaces is a smooth distance field.

    Lengths are in world units. If `height` is given, they are in the same unit as `height`, for example millimetres.
    Heights are measured upwards from the lowest point.

    Args:
        mesh: outer surface of the vessel with its opening closed, as silhouettes show it: a closed triangle mesh, world
            units.
        wall: thickness of the wall.
        foot: thickness of the bottom; by default that of the wall.
        fillet: radius of the rounded edge between wall and foot inside the vessel.
        level: height of the liquid; by default the vessel is full.
        closed: whether the wall continues over the top. Otherwise the part of the outer surface at the top that faces
            up is an opening.
        ior: refractive index of the wall.
        liquid_ior: refractive index of the liquid; 1 for an empty vessel.
        up: direction from the bottom to the top, world axes; its length does not matter.
        height: outer height of the vessel, in the unit of the other lengths.
        resolution, box_min, box_max, shell_voxels, accept_open_mesh, cache: see `SdfGrid`.
        absorption: coefficients per world unit: red, green and blue of wall and liquid, or one number for all.
        learn_absorption: learn the absorption.
        abbe: Abbe numbers of wall and liquid, or one for both, for dispersion.

    Attributes:
        lengths: wall, foot, fillet and level as given; a full vessel has no level.
    """

    nested = True
    _outer: Float[Tensor, "X Y Z"]  # signed distances to the outer surface, and to the outer surface without its lid
    _side: Float[Tensor, "X Y Z"]
    _heights: Float[Tensor, "X Y Z"]  # of the grid vertices above the lowest point

    def __init__(
        self,
        mesh: str,
        wall: Positive,
        foot: Positive | None = None,
        level: Positive | None = None,
        closed: bool = False,
        ior: Positive = 1.5,
        liquid_ior: Positive = 1.333,
        up: list[Coordinate] = [0.0, 0.0, 1.0],  # noqa: B006 (the registry reads and copies it)
        height: Positive | None = None,
        resolution: Resolution = 128,
        box_min: Sequence[float] | None = None,
        box_max: Sequence[float] | None = None,
        shell_voxels: Positive = 0.1,
        accept_open_mesh: bool = False,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: Learns = False,
        abbe: Sequence[Positive] = (),
        cache: bool = True,
        fillet: NotNegative = 0.0,
    ) -> None:
        require_bytes(BYTES_PER_VERTEX * resolution**3, f"medium.resolution={resolution}")
        surface = MeshSurface(mesh, accept_open_mesh).mesh
        box = grid_box(box_min, box_max, surface.bounds, resolution)
        spacing = float((box[1] - box[0]).min()) / (resolution - 1)
        glass, liquid = materials_of([ior, liquid_ior], absorption, learn_absorption, abbe, learn_ior=False)
        Medium.__init__(self)
        if level is None:
            self._set_materials([glass, liquid], ["wall", "liquid"])
        else:
            self._set_materials([glass, Material(1.0), liquid], ["wall", "air", "liquid"])
        self.shell = shell_voxels * spacing
        self.meshes = []  # rays are refracted at the distance field, not at triangles
        upwards = direction("medium.up", up)
        self.origin = local_origin(surface.vertices)
        box, surface = box - self.origin, surface.relative_to(self.origin)
        self._content_box = torch.from_numpy(surface.bounds).float()
        low, high = (float(end(surface.vertices @ upwards)) for end in (np.min, np.max))
        self.height = high - low if height is None else height
        self.unit = (high - low) / self.height
        self.lengths = {"wall": wall, "foot": wall if foot is None else foot, "fillet": fillet}
        if level is not None:
            self.lengths["level"] = level
        self._require_lengths_within()
        # The wall's inner surface and the fillet are made of these distances, and a refinement moves them.
        grid = Grid(box, resolution, cache=cache).widened((2 * wall + fillet) * self.unit)
        outer = side = torch.from_numpy(cached_distances(surface, grid))
        if not closed:
            side = torch.from_numpy(cached_distances(surface, grid, find_lid(surface, upwards)))
        heights = torch.from_numpy(grid.points @ upwards - low)
        for name, values in (("_outer", outer), ("_side", side), ("_heights", heights.float())):
            self.register_buffer(name, values, persistent=False)
        self._set_distances(torch.from_numpy(box).float())
        self.scale_absorption([torch.from_numpy(surface.bounds)] * len(self.materials))
        if not ((outer < 0) & (self.grids[1].distances < 0)).any():
            deepest = -float(side[outer < 0].min()) / self.unit
            raise NerfroError(
                f"medium.wall={wall:g} and medium.foot={self.lengths['foot']:g} leave no cavity: no point of the body "
                f"is deeper than {deepest:.3g}; give smaller ones, in world units, or medium.height= in the same unit"
            )

    def grown(self, outwards: Float[Tensor, "X Y Z"]) -> SdfVessel:
        """Return the vessel with a displaced outer surface. The cavity follows, as the wall keeps its thickness."""
        changed = variant(self, _outer=self._outer - outwards, _side=self._side - outwards)
        changed._set_distances(self.box)
        return changed

    def with_lengths(self, lengths: Mapping[str, float]) -> SdfVessel:
        """Return the vessel with other lengths; twice the wall plus the fillet is at most that of the original."""
        changed = variant(self, lengths=self.lengths | dict(lengths))
        changed._set_distances(self.box)
        return changed

    def _set_distances(self, box: Float[Tensor, "2 3"]) -> None:
        """Compute the signed distances of the outer body, the cavity and the space below the level."""
        wall, foot, fillet, *level = (length * self.unit for length in self.lengths.values())
        side, base = self._side + wall, foot - self._heights
        # In the corner, the distance is that to a circle that touches wall and foot.
        in_corner = (side > -fillet) & (base > -fillet) & (fillet > 0)
        circle = torch.hypot(side + fillet, base + fillet) - fillet
        cavity = torch.where(in_corner, circle, torch.maximum(side, base))
        distances = [self._outer, cavity, *(self._heights - height for height in level)]
        self._set_grids(DistanceGrid(values, box) for values in distances)

    def _require_lengths_within(self) -> None:
        heights = {name: value for name, value in self.lengths.items() if name in ("foot", "level")}
        if not 0 < heights["foot"] < heights.get("level", self.height) <= self.height:
            given = " and ".join(f"medium.{name}={value:g}" for name, value in heights.items())
            raise NerfroError(
                f"{given} is not allowed: heights are measured from the vessel's lowest point, the foot is below the "
                f"level, and the vessel is {self.height:.4g} high, in world units or the unit of medium.height="
            )
