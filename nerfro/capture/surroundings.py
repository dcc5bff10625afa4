"""What is seen around an object, learned from the pixels whose rays miss it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.boundaries.base import Boundary
from nerfro.boundaries.cube_map import project
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.cameras import Cameras
from nerfro.capture.pixel_blocks import PixelBlocks
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.data.base import Views
from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.mesh import TriangleMesh
from nerfro.light import to_linear
from nerfro.progress import bar
from nerfro.rays import Rays
from nerfro.rendering import composite
from nerfro.samplers.density_grid import DensityGridSampler
from nerfro.samplers.straight import straight_path
from nerfro.subdivision import pixel_rays
from nerfro.types import Exits

# Photographs are averaged down to at most so many pixels a side.
_MAX_PIXELS = 200
# Steps, pixels of a step and learning rate at the beginning and the end: of a sky, and of what is near.
_SKY_STEPS, _SKY_PIXELS = 300, 16384
_NEAR_STEPS, _NEAR_PIXELS = 400, 2048
_RATES = (0.03, 0.0015)
# Every so many-th view is held back, to see how well the surroundings are known where they were not learned.
HELD_BACK = 8
# A sky that leaves more than this share of the held-back views' variance unexplained is no sky: then things are near.
_NO_SKY = 0.25
# Less variance than this, of linear radiance, is none.
_LEVEL = 1e-4
# Texels a face's side of the map of directions that some ray has seen, at most, and pixels for each of them: few enough
# that where photographs have looked there are no holes.
_SEEN_TEXELS, _SEEN_PIXELS = 64, 8


@dataclass(frozen=True)
class Pixels:
    """Some pixels of photographs.

    Attributes:
        cameras: of all photographs.
        index: view * H * W + row * W + column of each.
        radiance: linear; at most 1, however bright the light was.
    """

    cameras: Cameras
    index: Int[Tensor, "P"]
    radiance: Float[Tensor, "P 3"]

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, chosen: Tensor) -> Pixels:
        return Pixels(self.cameras, self.index[chosen], self.radiance[chosen])

    @property
    def view(self) -> Int[Tensor, "P"]:
        return self.index // (self.cameras.height * self.cameras.width)

    @cached_property
    def rays(self) -> Rays:
        """Through the pixels' centres."""
        return pixel_rays(self.cameras, self.index)

    def some(self, count: int) -> Pixels:
        """At most so many of them, at random but always the same."""
        chosen = torch.randperm(len(self), generator=torch.Generator().manual_seed(0))[:count]
        return self[chosen.sort().values]


def robust(residual: Float[Tensor, "P 3"], half: float) -> Float[Tensor, "P"]:
    """r^2 / (r^2 + half^2), r^2 the mean over channels: 0 right, 1/2 at `half`, 1 unrelated (Geman and McClure)."""
    square = residual.square().mean(-1)
    return square / (square + half**2)


def divide_pixels(views: Views, mesh: TriangleMesh, max_pixels: int = _MAX_PIXELS) -> tuple[Pixels, Pixels]:
    """Pixels beside the object and pixels that it fills, by its masks, or by its mesh where there are none.

    Pixels on the outline and next to it are neither. Photographs of more than `max_pixels` a side are averaged down, in
    linear light.

    Raises:
        NerfroError: there are none of the one or the other.
    """
    blocks = PixelBlocks(views.cameras, max_pixels)
    cameras = blocks.cameras(views.cameras)
    silhouettes = None if views.masks is not None else mesh_silhouettes(mesh, cameras, 1).float()
    parts: list[list[tuple[Tensor, Tensor]]] = [[], []]
    for view in range(len(views)):
        radiance = blocks.mean(to_linear(views.images[view])).view(-1, 3)
        share = blocks.mean(views.masks[view]) if silhouettes is None else silhouettes[view]  # type: ignore[index]
        most, least = (functional.max_pool2d(x[None, None], 3, 1, 1)[0, 0] for x in (share, 1 - share))
        usable = torch.ones_like(share) if views.usable is None else blocks.mean(views.usable[view])
        for part, wanted in zip(parts, (most < 1e-3, least < 1e-3), strict=True):
            where = (wanted & (usable == 1)).flatten().nonzero()[:, 0]
            part.append((view * blocks.height * blocks.width + where, radiance[where]))
    beside, through = (Pixels(cameras, *(torch.cat(values) for values in zip(*part, strict=True))) for part in parts)
    if not len(beside) or not len(through):
        raise NerfroError(
            f"{len(beside)} pixels are seen beside the object and {len(through)} through it, and both are needed; "
            "take photographs that show the surroundings too, or give medium.ior="
        )
    return beside, through


@dataclass(frozen=True)
class Surroundings:
    """Learned surroundings.

    Attributes:
        boundary: returns them.
        seen: texels of directions that some ray has looked into, by face, row and column; None where all count.
        unexplained: share of the variance of held-back views' pixels that is not explained.
        colours: some of the radiances that were seen.
    """

    boundary: EnvironmentMap | Room
    seen: Bool[Tensor, "6 n n"] | None
    unexplained: float
    colours: Float[Tensor, "P 3"]

    def radiance(self, exits: Exits) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, "P"]]:
        """What a photograph shows in these directions, and whether that is known."""
        return self.boundary(exits).clamp(max=1), self.known(exits)

    def known(self, exits: Exits) -> Bool[Tensor, "P"]:
        """Whether it is known what a photograph shows in these directions."""
        if self.seen is None:
            return torch.ones(len(exits.directions), dtype=torch.bool)
        return self.seen[_texel(exits.directions, self.seen.shape[-1])]


def learn_surroundings(
    beside: Pixels, mesh: TriangleMesh, near: bool | None, progress: Callable[[float], None] = lambda done: None
) -> Surroundings:
    """Learn what is around an object from the pixels beside it.

    Args:
        beside: the pixels.
        mesh: the object.
        near: whether things are so near that rays of equal direction see different ones; None finds out.
        progress: is told the share done.
    """
    held_back = beside.view % HELD_BACK == HELD_BACK - 1
    learned, judges = beside[~held_back], beside[held_back] if held_back.any() else beside
    judges = judges.some(_SKY_PIXELS)
    found = None
    if not near:
        # Texels as wide as pixels, and no more of them than half the pixels: what none teaches would be speckle.
        side = min(1.5 * float(beside.cameras.fx.mean()) * math.pi / 2, math.sqrt(len(learned) / 12))
        levels = [4 * 2**level for level in range(16) if 4 * 2**level <= max(16, side)]
        boundary = EnvironmentMap(levels)
        _learn(boundary, learned, _SKY_STEPS, _SKY_PIXELS, progress)
        n = max(1, min(_SEEN_TEXELS, int(math.sqrt(len(learned) / (6 * _SEEN_PIXELS)))))
        seen = torch.zeros(6, n, n, dtype=torch.bool)
        seen[_texel(learned.rays.directions, n)] = True
        found = Surroundings(boundary, seen, _unexplained(boundary, judges), judges.radiance)
    if near or (near is None and found is not None and found.unexplained > _NO_SKY):
        middle = torch.from_numpy(mesh.bounds.mean(0)).float()
        distance = (beside.cameras.camera_to_world[:, :, 3] - middle).norm(dim=-1)
        field = Room(mesh.bounds, float(distance.mean()))
        _learn(field, learned, _NEAR_STEPS, _NEAR_PIXELS, progress)
        unexplained = _unexplained(field, judges)
        if found is None or unexplained < found.unexplained:
            found = Surroundings(field, None, unexplained, judges.radiance)
    assert found is not None
    return found


class Around:
    """What photographs show through an object and around it, found out when it is first asked for.

    Args:
        views: photographs with poses.
        mesh: the object.
        room: whether its surroundings are near; None finds out.
    """

    def __init__(self, views: Views, mesh: TriangleMesh, room: bool | None) -> None:
        self.views, self._mesh, self._room = views, mesh, room

    @property
    def near(self) -> bool | None:
        """Whether the surroundings are near; None where nothing has asked for them."""
        known = self.__dict__.get("surroundings")
        return None if known is None else isinstance(known.boundary, Room)

    @cached_property
    def through(self) -> Pixels:
        """Pixels that the object fills."""
        return self._divided[1]

    @cached_property
    def surroundings(self) -> Surroundings:
        """Learned, with a bar; how well they are known is printed."""
        with bar("surroundings") as told:
            found = learn_surroundings(self._divided[0], self._mesh, self._room, told)
        what = "near" if isinstance(found.boundary, Room) else "far away"
        print(f"surroundings: {what}; {found.unexplained:.1%} of other views' variance unexplained")
        return found

    @cached_property
    def _divided(self) -> tuple[Pixels, Pixels]:
        return divide_pixels(self.views, self._mesh)


class Room(Boundary):
    """Surroundings at finite distance: radiance in all of space, seen along the lines on which light leaves.

    Args:
        bounds: of the object, world units.
        radius: of the ball around its middle in which details are finest; best the cameras' distance.
    """

    def __init__(self, bounds: Float[np.ndarray, "2 3"], radius: float) -> None:
        super().__init__()
        low, high = bounds.tolist()
        self.field = HashGridField(
            low, high, radius, finest_resolution=512, log2_table_size=17, direction_bands=1, initial_depth=3.0
        )
        self.sampler = DensityGridSampler(box_min=low, box_max=high, radius=radius, looks=0.25, decay=0.6)
        self.draws: Draws | None = None  # random numbers of the step while it learns

    def forward(self, exits: Exits) -> Float[Tensor, "P 3"]:
        return self.seen(exits)[0]

    def seen(self, exits: Exits) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P"]]:
        """Radiance and how far away it comes from. What comes from infinity has the colour of what is farthest."""
        assert exits.positions is not None
        ones = torch.ones_like(exits.positions[:, 0])
        rays = Rays(exits.positions, exits.directions, exits.radii * ones, 0 * ones, ones)
        path = straight_path(rays)
        samples = self.sampler(path, None, self.draws)
        radiance = self.field(samples)
        rendered = composite(samples, radiance, radiance.rgb[:, -1], path)
        return rendered.rgb, rendered.depth


def _learn(boundary: Boundary, pixels: Pixels, steps: int, batch: int, progress: Callable[[float], None]) -> None:
    batch = min(batch, max(1024, len(pixels) // 16))
    generator = torch.Generator().manual_seed(0)
    first, last = _RATES
    optimizer = torch.optim.Adam(boundary.parameters(), first, eps=1e-15)
    with torch.enable_grad():
        for step in range(steps):
            if isinstance(boundary, Room):
                boundary.draws = Draws(0, step, torch.arange(batch))
            optimizer.param_groups[0]["lr"] = first * (last / first) ** (step / steps)
            drawn = pixels[torch.randint(len(pixels), (batch,), generator=generator)]
            predicted = boundary(Exits.unbent(drawn.rays))
            # Brighter than a photograph can tell is not wrong.
            seen = torch.where(drawn.radiance >= 1, predicted.clamp(max=1), predicted)
            optimizer.zero_grad()
            functional.mse_loss(seen, drawn.radiance).backward()
            optimizer.step()
            if isinstance(boundary, Room):
                boundary.sampler.after_step([boundary.field], Draws(0, step + 1, torch.arange(batch)))
            progress((step + 1) / steps)
    if isinstance(boundary, Room):
        boundary.draws = None
    boundary.eval().requires_grad_(False)


@torch.no_grad()
def _unexplained(boundary: Boundary, pixels: Pixels) -> float:
    error = boundary(Exits.unbent(pixels.rays)).clamp(max=1) - pixels.radiance
    return float(error.square().mean() / pixels.radiance.var(0).mean().clamp(min=_LEVEL))


def _texel(directions: Float[Tensor, "P 3"], n: int) -> tuple[Tensor, Tensor, Tensor]:
    face, coordinates = project(directions)
    column, row = ((coordinates + 1) / 2 * n).long().clamp(0, n - 1).unbind(-1)
    return face, row, column
