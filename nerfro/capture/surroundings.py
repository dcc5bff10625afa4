"""Reconstruction of the surroundings of an object from the pixels whose rays miss the object."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.backgrounds import cube_map
from nerfro.backgrounds.base import Background
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.core.compositing import composite
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_linear
from nerfro.core.progress import track
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.rays import Rays
from nerfro.core.types import WORLD_ORIGIN, Exits, Path
from nerfro.data.base import Views
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.space import Contracted
from nerfro.media.bodies import Bodies
from nerfro.samplers.base import straight_path
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.subdivision import pixel_rays
from nerfro.silhouettes.silhouettes import MASK_NOISE, VALIDATION_EVERY, PixelBlocks, mesh_silhouettes

# Least learned radiance of pixels that photographs clip at 1; the margin distinguishes them from other bright pixels.
CLIPPED_RADIANCE = 1.1


@dataclass(frozen=True)
class SurroundingsSettings(AlgorithmSettings):
    """Settings of the reconstruction of surroundings (`divide_pixels` and `learn_surroundings`).

    Attributes:
        max_pixels: photographs are downscaled to at most so many pixels per side, in linear radiance.
        sky_steps, sky_pixels: number of steps, and of pixels per step, for distant surroundings.
        near_steps, near_pixels: the same for near surroundings.
        rates: first and last learning rate.
        max_sky_residual: surroundings are near if a sky leaves more than this fraction of the variance of validation
            views unexplained.
        seen_texels, seen_pixels: resolution of the map of observed directions: largest number of texels per side of a
            face, and training pixels per texel, so that the map has no holes where photographs cover the surroundings.
    """

    max_pixels: int = 200
    sky_steps: int = 300
    sky_pixels: int = 16384
    near_steps: int = 400
    near_pixels: int = 2048
    rates: tuple[float, float] = (0.03, 0.0015)
    max_sky_residual: float = 0.25
    seen_texels: int = 64
    seen_pixels: int = 8


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

    def __getitem__(self, selection: Tensor) -> Pixels:
        return Pixels(self.cameras, self.index[selection], self.radiance[selection])

    @property
    def view(self) -> Int[Tensor, "Q"]:
        return self.cameras.view_of(self.index)

    @cached_property
    def rays(self) -> Rays:
        """Rays through the centres of the pixels."""
        return pixel_rays(self.cameras, self.index)

    def split(self) -> tuple[Pixels, Pixels]:
        """Split the pixels into those of training and of validation views; all are both if one of these has none."""
        validates = self.view % VALIDATION_EVERY == VALIDATION_EVERY - 1
        return (self, self) if validates.all() or not validates.any() else (self[~validates], self[validates])

    def some(self, count: int) -> Pixels:
        """Select at most `count` random pixels with a fixed seed."""
        drawn = torch.randperm(len(self), generator=torch.Generator().manual_seed(0))[:count]
        return self[drawn.sort().values]


def robust_scale(surroundings: Surroundings) -> float:
    """Return the scale of the Geman-McClure loss for residuals against the surroundings, linear radiance.

    At a residual of half the standard deviation of the surroundings, the loss is 1/2 of its maximum and the weight 1/4.
    The loss is robust, because opaque objects inside the body spoil many pixels.
    """
    colours = surroundings.colours
    return max(0.5 * float(colours.std(0, correction=min(1, len(colours) - 1)).mean()), 1e-3)


def divide_pixels(
    views: Views, mesh: TriangleMesh, settings: SurroundingsSettings = SurroundingsSettings()
) -> tuple[Pixels, Pixels]:
    """Select the pixels beside the object and the pixels inside its silhouette.

    Silhouettes are the masks, or projections of the mesh if there are no masks. Pixels on and next to the outline
    belong to neither selection.

    Args:
        views: photographs with poses.
        mesh: surface of the object, in the coordinates of the poses.
        settings: size of the photographs.

    Returns:
        Pixels beside the object, and pixels inside.

    Raises:
        NerfroError: one of the selections is empty.
    """
    blocks = PixelBlocks(views.cameras, settings.max_pixels)
    cameras = blocks.cameras(views.cameras)
    silhouettes = None if views.masks is not None else mesh_silhouettes(mesh, cameras, 1).float()
    parts: list[list[tuple[Tensor, Tensor]]] = [[], []]
    for view in range(len(views)):
        # Predictions are clipped as well, also for photographs in linear light.
        radiance = blocks.mean(to_linear(views.images[view].clamp(0, 1))).view(-1, 3)
        if silhouettes is None:
            # Mattes and JPEG files rarely reach 0 and 1.
            coverage = blocks.mean(((views.masks[view] - MASK_NOISE) / (1 - 2 * MASK_NOISE)).clamp(0, 1))  # type: ignore[index]
        else:
            coverage = silhouettes[view]
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
        background: background model. Its radiance is `CLIPPED_RADIANCE` or more where photographs are clipped.
        seen: observed directions, by face, row and column of a cube map; None if all directions are known.
        unexplained: fraction of the variance of the validation pixels that is not explained.
        colours: a sample of observed radiances.
        clipped_radiance: linear radiance of red, green and blue where photographs are clipped, at least 1.
    """

    background: EnvironmentMap | Room | RoomPanorama
    seen: Bool[Tensor, "6 n n"] | None
    unexplained: float
    colours: Float[Tensor, "Q 3"]
    clipped_radiance: Float[Tensor, "3"] = field(default_factory=lambda: torch.ones(3))

    def radiance(self, exits: Exits) -> Float[Tensor, "P 3"]:
        """Return the linear radiance along exit rays, which a photograph clips at 1."""
        recorded, share = recorded_and_clipped(self.background(exits))
        return recorded + share * (self.clipped_radiance - 1)

    def known(self, exits: Exits) -> Bool[Tensor, "P"]:
        """Test whether the radiance in the exit directions is known."""
        if self.seen is None:
            return torch.ones(len(exits.directions), dtype=torch.bool)
        return self.seen.flatten()[cube_map.nearest_texel(exits.directions, self.seen.shape[-1])]


def recorded_radiance(path: Path, radiance: Callable[[Exits], Tensor]) -> Float[Tensor, "R 3"]:
    """Compute the linear radiance of rays that a photograph records, clipped at 1.

    Args:
        path: the paths, which may cross absorbing bodies.
        radiance: radiance of the surroundings along exit rays, linear.
    """
    return path.sum_polylines(radiance(path.exits()) * path.whole_transmittance()).clamp(max=1)


def recorded_and_clipped(learned: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Split the radiance of a background into the radiance that a photograph records, and the share that it clips."""
    return learned.clamp(max=1), ((learned - 1) / (CLIPPED_RADIANCE - 1)).clamp(0, 1)


def learn_surroundings(
    beside: Pixels, mesh: TriangleMesh, near: bool | None, settings: SurroundingsSettings = SurroundingsSettings()
) -> Surroundings:
    """Reconstruct the surroundings of an object from the pixels beside the object.

    Args:
        beside: pixels beside the object.
        mesh: surface of the object.
        near: whether the surroundings are so near that parallel rays see different points; None decides by validation
            views.
        settings: steps and limits.
    """
    settings.use()
    if near:
        beside.cameras.refuse_turntable("room=true makes surroundings a part of the object", "leave room out")
    near = False if beside.cameras.turntable else near
    training, validation = beside.split()
    validation = validation.some(settings.sky_pixels)
    sky = None
    if not near:
        # Texels are as wide as pixels, and at most half as many, because unobserved texels would be noise.
        side = min(1.5 * float(beside.cameras.fx.mean()) * math.pi / 2, math.sqrt(len(training) / 12))
        levels = [4 * 2**level for level in range(16) if 4 * 2**level <= max(16, side)]
        n = max(1, min(settings.seen_texels, int(math.sqrt(len(training) / (6 * settings.seen_pixels)))))
        seen = torch.zeros(6, n, n, dtype=torch.bool)
        seen.view(-1)[cube_map.nearest_texel(Exits.unbent(training.rays).directions, n)] = True
        size = settings.sky_steps, settings.sky_pixels
        sky = _learned(EnvironmentMap(levels), seen, training, validation, size, settings.rates)
        if near is False or sky.unexplained <= settings.max_sky_residual:
            return sky
    middle = torch.from_numpy(mesh.bounds.mean(0)).float()
    distance = (beside.cameras.camera_to_world[:, :, 3] - middle).norm(dim=-1)
    field, size = Room(mesh.bounds, float(distance.mean())), (settings.near_steps, settings.near_pixels)
    room = _learned(field, None, training, validation, size, settings.rates)
    return room if sky is None or room.unexplained < sky.unexplained else sky


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
        surroundings = self.__dict__.get("surroundings")
        near = self._room if surroundings is None else isinstance(surroundings.background, Room)
        return None if near is None else "near" if near else "far"

    @cached_property
    def through(self) -> Pixels:
        """Pixels inside the silhouette of the object."""
        return self._divided[1]

    @cached_property
    def surroundings(self) -> Surroundings:
        """Reconstructed surroundings; prints their type and accuracy."""
        learned = learn_surroundings(self._divided[0], self._mesh, self._room)
        distance, explained = "near" if isinstance(learned.background, Room) else "far away", 1 - learned.unexplained
        print(f"surroundings: {distance}; {explained:.1%} of the variance of validation views is explained")
        return learned

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
        self.radius, space = radius, Contracted(bounds, radius)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(0)
            self.field = HashGridField(
                space, finest_resolution=512, log2_table_size=17, direction_bands=1, initial_depth=3.0
            )
        self.sampler = DensityGridSampler(space, update_fraction=0.25, decay=0.6)

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


def _learned(
    background: EnvironmentMap | Room,
    seen: Bool[Tensor, "6 n n"] | None,
    training: Pixels,
    validation: Pixels,
    size: tuple[int, int],
    rates: tuple[float, float],
) -> Surroundings:
    """Learn a background by gradient descent, and measure its error.

    Args:
        background: the background, which is changed.
        seen: see `Surroundings`.
        training, validation: pixels beside the object.
        size: number of steps, and largest number of pixels in each.
        rates: first and last learning rate.
    """
    steps, batch = size[0], min(size[1], max(1024, len(training) // 16))
    generator = torch.Generator().manual_seed(0)
    first, last = rates
    optimizer = torch.optim.Adam(background.parameters(), first, eps=1e-15)
    with torch.enable_grad():
        for step in track("surroundings", range(steps)):
            optimizer.param_groups[0]["lr"] = first * (last / first) ** (step / steps)
            drawn = training[torch.randint(len(training), (batch,), generator=generator)]
            exits = Exits.unbent(drawn.rays)
            draws = (Draws(0, step, torch.arange(batch)),) if isinstance(background, Room) else ()
            predicted = background(exits, *draws)
            # A photograph clips radiance at 1, so brighter predictions of clipped pixels are no error.
            is_clipped = drawn.radiance >= 1
            recorded = torch.where(is_clipped, predicted.clamp(max=CLIPPED_RADIANCE), predicted)
            optimizer.zero_grad()
            functional.mse_loss(recorded, drawn.radiance.masked_fill(is_clipped, CLIPPED_RADIANCE)).backward()
            optimizer.step()
            if isinstance(background, Room):
                background.sampler.update([background.field], Draws(0, step + 1, torch.arange(batch)))
    background.eval().requires_grad_(False)
    error = background(Exits.unbent(validation.rays)).clamp(max=1) - validation.radiance
    variance = validation.radiance.var(0, correction=min(1, len(validation) - 1))
    unexplained = float(error.square().mean() / variance.mean().clamp(min=1e-4))
    return Surroundings(background, seen, unexplained, validation.radiance)


class RoomPanorama(Background):
    """A panorama with depth around a point; the lookup intersects exit rays from other positions with the depth.

    A radiance field has no useful gradient for the refinement of a surface, because its details are finer than the
    displacements. A panorama can be blurred, and depth makes the lookup follow the exit ray. The panorama lacks
    surfaces that are hidden from the point.

    Args:
        middle: centre of the panorama.
        colours: linear radiance by direction.
        distances: distance of each texel (see `cube_map.texel_directions`), world units.
    """

    def __init__(self, middle: Float[Tensor, "3"], colours: EnvironmentMap, distances: Float[Tensor, "T"]) -> None:
        super().__init__()
        self.middle, self.colours, self.distances = middle, colours, distances
        side = round((len(distances) / 6) ** 0.5)
        self._side, self._padded = side, cube_map.padded_texels(side).flatten()

    def forward(self, exits: Exits) -> Float[Tensor, "P 3"]:
        """Look up the radiance along exit rays, differentiable by their positions and directions."""
        assert exits.positions is not None
        starts = exits.positions - self.middle
        with torch.no_grad():
            lengths = self._lengths(starts, exits.directions)
        return self.colours(Exits(starts + lengths * exits.directions))

    def _lengths(self, starts: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]) -> Float[Tensor, "P 1"]:
        """Intersect exit rays with the depth of the panorama by fixed-point iteration; returns arc lengths."""
        along = (starts * directions).sum(-1, keepdim=True)
        square = starts.square().sum(-1, keepdim=True)
        seen, lengths = directions, torch.zeros_like(along)
        texels = self.distances[:, None].expand(-1, 3)
        for _ in range(5):  # few suffice, because the object is small beside its surroundings
            distance = cube_map.lookup_in_torch(*cube_map.project(seen), texels, self._padded, [self._side])[:, :1]
            lengths = ((along.square() - square + distance.square()).clamp(min=0).sqrt() - along).clamp(min=0)
            seen = starts + lengths * directions
        return lengths


@torch.no_grad()
def panorama_of(room: Room, medium: Bodies, middle: Float[Tensor, "3"], side: int = 192) -> RoomPanorama:
    """Render a panorama of near surroundings from the surface of an object outwards.

    Args:
        room: the surroundings.
        medium: the object.
        middle: centre of the panorama.
        side: texels per side of a face; 192 are half a degree each.
    """
    radius = float((medium.box[1] - medium.box[0]).norm())
    radiance, distances = [], []
    for directions in cube_map.texel_directions(side).split(16384):
        ones = torch.ones(len(directions))
        inwards = Rays(middle + radius * directions, -directions, 0 * ones, 0 * ones, 2 * radius * ones)
        path = Snell()(inwards, medium)
        starts = torch.where(path.refracted[:, None], path.positions[:, 1], middle)
        seen, distance = room.seen(Exits(directions, starts))
        radiance.append(seen)
        distances.append(distance + (starts - middle).norm(dim=-1))
    return RoomPanorama(middle, EnvironmentMap.of_texels(torch.cat(radiance)), torch.cat(distances))
