"""Reconstruction of the surroundings of an object from the pixels whose rays miss the object."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.backgrounds.base import Background
from nerfro.backgrounds.cube_map import project
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_linear
from nerfro.core.progress import fraction_bar
from nerfro.core.rays import Rays
from nerfro.core.types import WORLD_ORIGIN, Exits
from nerfro.data.base import Views
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.mesh import TriangleMesh
from nerfro.rendering import composite
from nerfro.samplers.paths.straight import straight_path
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.subdivision import pixel_rays
from nerfro.silhouettes.silhouettes import VALIDATION_EVERY, PixelBlocks, mesh_silhouettes

# Photographs are downscaled to at most so many pixels per side, in linear radiance.
_MAX_PIXELS = 200
# Number of steps and pixels per step for distant and near surroundings, and first and last learning rate.
_SKY_STEPS, _SKY_PIXELS = 300, 16384
_NEAR_STEPS, _NEAR_PIXELS = 400, 2048
_RATES = (0.03, 0.0015)
# Surroundings are near if a sky leaves more than this fraction of the variance of validation views unexplained.
_MAX_SKY_RESIDUAL = 0.25
# Lower bound of the variance of linear radiance.
_MIN_VARIANCE = 1e-4
# Resolution of the map of observed directions: maximum texels per side of a face, and training pixels per texel, chosen
# so that the map has no holes where photographs cover the surroundings.
_SEEN_TEXELS, _SEEN_PIXELS = 64, 8
# Scale of the Geman-McClure loss as a fraction of the standard deviation of the surroundings: residual at which the
# loss is 1/2 of its maximum and the weight 1/4. The loss is robust, because opaque objects inside the body spoil many
# pixels.
_SCALE_FRACTION = 0.5
# Lower bound of this scale, linear radiance.
_MIN_SCALE = 1e-3


@dataclass(frozen=True)
class Pixels:
    """A selection of pixels of photographs.

    Attributes:
        cameras: cameras of all photographs.
        index: view * H * W + row * W + column of each pixel.
        radiance: linear radiance, clipped at 1 by the photograph.
    """

    cameras: Cameras
    index: Int[Tensor, "Q"]
    radiance: Float[Tensor, "Q 3"]

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, chosen: Tensor) -> Pixels:
        return Pixels(self.cameras, self.index[chosen], self.radiance[chosen])

    @property
    def view(self) -> Int[Tensor, "Q"]:
        return self.cameras.view_of(self.index)

    @cached_property
    def rays(self) -> Rays:
        """Rays through the centres of the pixels."""
        return pixel_rays(self.cameras, self.index)

    def split(self) -> tuple[Pixels, Pixels]:
        """Split the pixels into those of training and of validation views; without the latter, all pixels validate."""
        validates = self.view % VALIDATION_EVERY == VALIDATION_EVERY - 1
        return self[~validates], self[validates] if validates.any() else self

    def some(self, count: int) -> Pixels:
        """Select at most `count` random pixels with a fixed seed."""
        chosen = torch.randperm(len(self), generator=torch.Generator().manual_seed(0))[:count]
        return self[chosen.sort().values]


def robust_scale(surroundings: Surroundings) -> float:
    """Return the scale of the Geman-McClure loss for residuals against the surroundings, linear radiance."""
    return max(_SCALE_FRACTION * float(surroundings.colours.std(0).mean()), _MIN_SCALE)


def divide_pixels(views: Views, mesh: TriangleMesh) -> tuple[Pixels, Pixels]:
    """Select the pixels beside the object and the pixels inside its silhouette.

    Silhouettes are the masks, or projections of the mesh if there are no masks. Pixels on and next to the outline
    belong to neither selection.

    Args:
        views: photographs with poses.
        mesh: surface of the object.

    Returns:
        Pixels beside the object, and pixels inside.

    Raises:
        NerfroError: one of the selections is empty.
    """
    blocks = PixelBlocks(views.cameras, _MAX_PIXELS)
    cameras = blocks.cameras(views.cameras)
    silhouettes = None if views.masks is not None else mesh_silhouettes(mesh, cameras, 1).float()
    parts: list[list[tuple[Tensor, Tensor]]] = [[], []]
    for view in range(len(views)):
        radiance = blocks.mean(to_linear(views.images[view])).view(-1, 3)
        coverage = blocks.mean(views.masks[view]) if silhouettes is None else silhouettes[view]  # type: ignore[index]
        # Largest fractions of the object and of the background in a neighbourhood of 3x3 pixels.
        covered, uncovered = (functional.max_pool2d(x[None, None], 3, 1, 1)[0, 0] for x in (coverage, 1 - coverage))
        usable = torch.ones_like(coverage) if views.usable is None else blocks.mean(views.usable[view])
        for part, wanted in zip(parts, (covered < 1e-3, uncovered < 1e-3), strict=True):
            where = (wanted & (usable == 1)).flatten().nonzero()[:, 0]
            part.append((view * blocks.height * blocks.width + where, radiance[where]))
    beside, through = (Pixels(cameras, *(torch.cat(values) for values in zip(*part, strict=True))) for part in parts)
    if not len(beside) or not len(through):
        raise NerfroError(
            f"{len(beside)} pixels lie beside the object and {len(through)} inside its silhouette, and both are "
            "needed; take photographs that also show the surroundings, or give medium.ior="
        )
    return beside, through


@dataclass(frozen=True)
class Surroundings:
    """Reconstructed surroundings.

    Attributes:
        background: background model that returns the background radiance.
        seen: observed directions, by face, row and column of a cube map; None if all directions are known.
        unexplained: fraction of the variance of the validation pixels that is not explained.
        colours: a sample of observed radiances.
    """

    background: EnvironmentMap | Room
    seen: Bool[Tensor, "6 n n"] | None
    unexplained: float
    colours: Float[Tensor, "Q 3"]

    def radiance(self, exits: Exits) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, "P"]]:
        """Return the radiance that a photograph records along exit rays, and whether the radiance is known."""
        return self.background(exits).clamp(max=1), self.known(exits)

    def known(self, exits: Exits) -> Bool[Tensor, "P"]:
        """Test whether the radiance in the exit directions is known."""
        if self.seen is None:
            return torch.ones(len(exits.directions), dtype=torch.bool)
        return self.seen[_texel(exits.directions, self.seen.shape[-1])]


def learn_surroundings(
    beside: Pixels, mesh: TriangleMesh, near: bool | None, progress: Callable[[float], None] = lambda done: None
) -> Surroundings:
    """Reconstruct the surroundings of an object from the pixels beside the object.

    Args:
        beside: pixels beside the object.
        mesh: surface of the object.
        near: whether the surroundings are so near that parallel rays see different points; None decides by validation
            views.
        progress: called with the completed fraction.
    """
    training, validation = beside.split()
    validation = validation.some(_SKY_PIXELS)
    found = None
    if not near:
        # Texels are as wide as pixels, and at most half as many, because unobserved texels would be noise.
        side = min(1.5 * float(beside.cameras.fx.mean()) * math.pi / 2, math.sqrt(len(training) / 12))
        levels = [4 * 2**level for level in range(16) if 4 * 2**level <= max(16, side)]
        background = EnvironmentMap(levels)
        _learn(background, training, _SKY_STEPS, _SKY_PIXELS, progress)
        n = max(1, min(_SEEN_TEXELS, int(math.sqrt(len(training) / (6 * _SEEN_PIXELS)))))
        seen = torch.zeros(6, n, n, dtype=torch.bool)
        seen[_texel(training.rays.directions, n)] = True
        found = Surroundings(background, seen, _unexplained(background, validation), validation.radiance)
    if near or (near is None and found is not None and found.unexplained > _MAX_SKY_RESIDUAL):
        middle = torch.from_numpy(mesh.bounds.mean(0)).float()
        distance = (beside.cameras.camera_to_world[:, :, 3] - middle).norm(dim=-1)
        field = Room(mesh.bounds, float(distance.mean()))
        _learn(field, training, _NEAR_STEPS, _NEAR_PIXELS, progress)
        unexplained = _unexplained(field, validation)
        if found is None or unexplained < found.unexplained:
            found = Surroundings(field, None, unexplained, validation.radiance)
    assert found is not None
    return found


class Observations:
    """Observations of an object and its surroundings, computed on first use.

    Args:
        views: photographs with poses.
        mesh: surface of the object.
        room: whether the surroundings are near; None decides by validation views.
        shift: origin of the observations in the coordinates of views and mesh.

    Attributes:
        views: the photographs, with poses relative to `shift`.
    """

    def __init__(
        self, views: Views, mesh: TriangleMesh, room: bool | None, shift: Float[np.ndarray, "3"] = WORLD_ORIGIN
    ) -> None:
        self.views = replace(views, cameras=views.cameras.relative_to(shift))
        self.shift, self._mesh, self._room = shift, mesh.relative_to(shift), room

    @property
    def distance(self) -> Literal["near", "far"] | None:
        """Distance of the surroundings, `near` or `far`; None if neither given nor reconstructed."""
        known = self.__dict__.get("surroundings")
        near = self._room if known is None else isinstance(known.background, Room)
        return None if near is None else "near" if near else "far"

    @cached_property
    def through(self) -> Pixels:
        """Pixels inside the silhouette of the object."""
        return self._divided[1]

    @cached_property
    def surroundings(self) -> Surroundings:
        """Reconstructed surroundings; prints their type and accuracy."""
        with fraction_bar("surroundings") as progress:
            found = learn_surroundings(self._divided[0], self._mesh, self._room, progress)
        distance = "near" if isinstance(found.background, Room) else "far away"
        print(f"surroundings: {distance}; {1 - found.unexplained:.1%} of the variance of validation views is explained")
        return found

    @cached_property
    def _divided(self) -> tuple[Pixels, Pixels]:
        return divide_pixels(self.views, self._mesh)


class Room(Background):
    """Near surroundings: a radiance field in all of space, rendered along the exit rays.

    The field is initialized with a fixed seed, so that results do not depend on random numbers drawn earlier.

    Args:
        bounds: corners of the bounding box of the object, world units.
        radius: radius of the ball around the object outside which space is contracted; best the camera distance.
    """

    def __init__(self, bounds: Float[np.ndarray, "2 3"], radius: float) -> None:
        super().__init__()
        low, high = bounds.tolist()
        self.radius = radius
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(0)
            self.field = HashGridField(
                low, high, radius, finest_resolution=512, log2_table_size=17, direction_bands=1, initial_depth=3.0
            )
        self.sampler = DensityGridSampler(box_min=low, box_max=high, radius=radius, update_fraction=0.25, decay=0.6)

    def forward(self, exits: Exits, draws: Draws | None = None) -> Float[Tensor, "P 3"]:
        return self.seen(exits, draws)[0]

    def seen(self, exits: Exits, draws: Draws | None = None) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P"]]:
        """Render radiance and its distance along exit rays. Transmitted light has the colour of the farthest sample.

        Args:
            exits: the rays.
            draws: random numbers of a training step; None for evenly spaced samples.
        """
        assert exits.positions is not None
        ones = torch.ones_like(exits.positions[:, 0])
        rays = Rays(exits.positions, exits.directions, exits.radii * ones, 0 * ones, self.radius * ones)
        path = straight_path(rays)
        samples = self.sampler(path, None, draws)
        values = self.field(samples)
        rendered = composite(samples, values, values.radiance[:, -1], path)
        return rendered.radiance, rendered.depth


def _learn(background: Background, pixels: Pixels, steps: int, batch: int, progress: Callable[[float], None]) -> None:
    batch = min(batch, max(1024, len(pixels) // 16))
    generator = torch.Generator().manual_seed(0)
    first, last = _RATES
    optimizer = torch.optim.Adam(background.parameters(), first, eps=1e-15)
    with torch.enable_grad():
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = first * (last / first) ** (step / steps)
            drawn = pixels[torch.randint(len(pixels), (batch,), generator=generator)]
            exits = Exits.unbent(drawn.rays)
            draws = (Draws(0, step, torch.arange(batch)),) if isinstance(background, Room) else ()
            predicted = background(exits, *draws)
            # A photograph clips radiance at 1, so brighter predictions of clipped pixels are no error.
            seen = torch.where(drawn.radiance >= 1, predicted.clamp(max=1), predicted)
            optimizer.zero_grad()
            functional.mse_loss(seen, drawn.radiance).backward()
            optimizer.step()
            if isinstance(background, Room):
                background.sampler.update([background.field], Draws(0, step + 1, torch.arange(batch)))
            progress((step + 1) / steps)
    background.eval().requires_grad_(False)


@torch.no_grad()
def _unexplained(background: Background, pixels: Pixels) -> float:
    error = background(Exits.unbent(pixels.rays)).clamp(max=1) - pixels.radiance
    return float(error.square().mean() / pixels.radiance.var(0).mean().clamp(min=_MIN_VARIANCE))


def _texel(directions: Float[Tensor, "P 3"], n: int) -> tuple[Tensor, Tensor, Tensor]:
    face, coordinates = project(directions)
    column, row = ((coordinates + 1) / 2 * n).long().clamp(0, n - 1).unbind(-1)
    return face, row, column
