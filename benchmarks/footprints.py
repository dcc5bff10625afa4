"""Compare more rays per pixel of glass with lookups of the sky at the level of a ray's footprint.

    python benchmarks/footprints.py [--sky torus] [--views 2]
    python benchmarks/footprints.py --run RUN [--views 3]

The first form renders an empty rounded cube under a known sky without partial reflection. The reference has 256 rays
per pixel. Rows differ in the number of rays, columns in the level of the sky. Scores are of pixels of glass.
The second form renders test views of a trained run, with lookups of the learned sky by footprint in subdivided pixels.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tracing import BOX, EDGE, HALF_SIDE, N_CUBE, grid_distances

import nerfro
from nerfro.boundaries import cube_map
from nerfro.boundaries.base import Boundary
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.boundaries.envmap import _radiance as radiance_of
from nerfro.cameras import Cameras
from nerfro.data.blender import BlenderData
from nerfro.files import lat_long
from nerfro.light import to_srgb
from nerfro.media.sdf_grid import SdfGrid
from nerfro.rays import Rays
from nerfro.registry import discover
from nerfro.rendering import Renderer
from nerfro.samplers.paths.snell import Snell
from nerfro.subdivision import Subdivision, contrast, divergence, neighbour_rays, part_rays, pixel_rays
from nerfro.types import Exits
from tests.closed_forms import RoundedBox

discover()
lat_long_texture = import_module("nerfro_plugins.synthetic_scenes.scene").lat_long_texture
find_scene = import_module("nerfro_plugins.synthetic_scenes.synthesis").find_scene

TRUTH = 16  # rays a side of a pixel
SIDES = (1, 2, 3, 4, 6, 8)  # rays a side
CHUNK = 200_000


class Pyramid:
    """Mip levels of a sky as cube maps with bilinear lookup."""

    def __init__(self, texels: Float[Tensor, "6*n*n 3"]) -> None:
        n = math.isqrt(len(texels) // 6)
        picture = texels.view(6, n, n, 3)
        self.resolutions, self._texels = [], []
        while True:
            n = picture.shape[1]
            self.resolutions.append(n)
            self._texels.append(picture.reshape(-1, 3))
            if n <= 8:
                break
            picture = picture.view(6, n // 2, 2, n // 2, 2, 3).mean((2, 4))
        self._padded = [cube_map.padded_texels(n).flatten() for n in self.resolutions]

    def __call__(self, directions: Float[Tensor, "P 3"], widths: Float[Tensor, "P"] | None = None) -> Tensor:
        """Radiance [P, 3] of directions; `widths` of footprints in radians ask for a level, else the finest answers.

        As a sum of levels in which each is weighted by a smoothstep of its texel over the footprint.
        """
        result = self._level(0, directions)
        if widths is None:
            return result
        previous, total = torch.zeros_like(widths), torch.zeros_like(result)
        for level, n in enumerate(self.resolutions):
            shown = torch.ones_like(widths) if n == self.resolutions[-1] else detail_shown(n, widths)
            weight, previous = shown - previous, shown
            some = weight > 0
            total[some] += weight[some, None] * self._level(level, directions[some])
        return total

    def _level(self, level: int, directions: Tensor) -> Tensor:
        levels = cube_map.CubeLevels((self.resolutions[level],))
        found = [
            cube_map.lookup(*cube_map.project(some), self._texels[level], self._padded[level], levels)
            for some in directions.split(CHUNK)
        ]
        return torch.cat(found) if found else torch.zeros(0, 3)


def detail_shown(resolution: int, widths: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
    """How much of what a level adds to the next coarser one is shown: all where its texel is as wide as the footprint,
    nothing where it is half as wide or less."""
    x = (2 * (0.5 * math.pi / resolution) / widths.clamp(min=1e-9) - 1).clamp(0, 1)
    return x * x * (3 - 2 * x)


class ByFootprint(Boundary):
    """A learned sky that takes the `radii` of exits for the widths of footprints, radians.

    Args:
        sky: as it was trained.
        averaged: whether its finest texels are averaged to a pyramid, or its learned levels are weighted.
    """

    def __init__(self, sky: EnvironmentMap, averaged: bool) -> None:
        super().__init__()
        self._sky, self._averaged = sky, averaged
        self._pyramid = Pyramid(sky(Exits(cube_map.texel_directions(sky.levels.resolutions[-1]))))

    def forward(self, exits: Exits) -> Tensor:
        finest, sky = self._sky(exits), self._sky
        assert isinstance(exits.radii, Tensor)
        some = (detail_shown(sky.levels.resolutions[-1], exits.radii) < 1).nonzero()[:, 0]
        directions, widths = exits.directions[some].float(), exits.radii[some]
        if self._averaged:
            return finest.index_copy(0, some, self._pyramid(directions, widths))
        raw = torch.zeros_like(directions)
        for level, (n, texels) in enumerate(zip(sky.levels.resolutions, sky.texels_of_levels(), strict=True)):
            looked_up = cube_map.lookup(*cube_map.project(directions), *texels, cube_map.CubeLevels((n,)))
            raw += looked_up if level == 0 else detail_shown(n, widths)[:, None] * looked_up
        return finest.index_copy(0, some, radiance_of(raw))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sky", default="torus", help="scene whose sky is taken")
    parser.add_argument("--views", type=int, default=2, help="test views")
    parser.add_argument("--run", type=Path, help="folder of a trained run")
    parser.add_argument("--size", type=int, default=128, help="pixels a side of the views of the rounded cube")
    parser.add_argument("--resolution", type=int, default=256, help="of the cube's grid of distances")
    parser.add_argument("--texture", type=int, default=1024, help="height of the exact sky in texels")
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    if arguments.run is not None:
        trained_run(arguments.run, arguments.views)
        return
    scene = find_scene(arguments.sky)
    sky = torch.from_numpy(lat_long_texture(scene.sky, arguments.texture))
    finest = arguments.texture // 2  # texels along a face's side; by default 0.18 degrees
    pyramid = Pyramid(lat_long.sample(sky.float(), cube_map.texel_directions(finest), 4 * finest))
    medium = SdfGrid.from_distances(
        grid_distances(RoundedBox(HALF_SIDE, EDGE, N_CUBE).double(), arguments.resolution), BOX, [N_CUBE], 0.002
    )
    cameras = BlenderData().load("test").cameras.resized(arguments.size, arguments.size)
    views = [
        View(cameras, view * (len(cameras) // arguments.views), medium, pyramid) for view in range(arguments.views)
    ]
    print(f"sky of {arguments.sky}, {arguments.views} views, {sum(len(v.pixels) for v in views)} pixels of glass\n")
    print("| rays | a pixel of the glass | of the picture | finest level | by footprint: 0.35 | 0.5 | 1 of spacing |")
    print("|---|---|---|---|---|---|---|")
    scales = (None, 0.35, 0.5, 1.0)
    for side in SIDES:
        row = [f"{score(views, [view.mean(side, scale) for view in views]):.1f}" for scale in scales]
        print(f"| {side}x{side} | {side * side} | | " + " | ".join(row) + " |", flush=True)
    divided = [view.divided() for view in views]
    for side in SIDES[2:-1]:
        of_glass, of_picture = (2 + side**2 * torch.cat(shares).float().mean() for shares in zip(*divided, strict=True))
        pairs = [(view, some) for view, (some, _) in zip(views, divided, strict=True)]
        found = [[view.as_evaluated(side, scale, some) for view, some in pairs] for scale in scales]
        row = [f"{score(views, means):.1f}" for means in found]
        print(
            f"| as evaluated, {side}x{side} | {of_glass:.1f} | {of_picture:.1f} | " + " | ".join(row) + " |", flush=True
        )
    for budget in (6.0, 9.0):
        needed = [by_need(views, budget, scale) for scale in scales]
        row = [f"{score(views, means):.1f}" for means, _ in needed]
        print(f"| by need, from 2x2 | {needed[0][1]:.1f} | | " + " | ".join(row) + " |", flush=True)


def trained_run(run: Path, num_views: int) -> None:
    """Print the mean PSNR of test views by rays a side of divided pixels, and by what the sky is asked in these."""
    scene = nerfro.load(run, device="cpu")
    model, views = scene.renderer, scene.views().checked()
    sky = model.scene.boundary
    assert isinstance(sky, EnvironmentMap)
    chosen = range(0, len(views), len(views) // num_views)[:num_views]
    print(f"{run}, test views {', '.join(map(str, chosen))}\n")
    print("| rays in divided pixels | a pixel, mean | sky as learned | levels averaged | levels left out |")
    print("|---|---|---|---|---|")
    for side in (2, 3):
        row, rays = [], 0.0
        for boundary in (sky, ByFootprint(sky, averaged=True), ByFootprint(sky, averaged=False)):
            model.scene.boundary = boundary
            shown = [rendered(model, views.cameras, view, replace(scene.subdivision, side=side)) for view in chosen]
            errors = [
                (rgb - views.images[view].reshape(-1, 3)).square().mean()
                for view, (rgb, _) in zip(chosen, shown, strict=True)
            ]
            row.append(f"{sum(-10 * math.log10(float(error)) for error in errors) / len(errors):.2f}")
            rays = sum(number for _, number in shown) / len(shown)
        print(f"| {side}x{side} | {rays:.1f} | " + " | ".join(row) + " |", flush=True)


def rendered(model: Renderer, cameras: Cameras, view: int, subdivision: Subdivision) -> tuple[Tensor, float]:
    """A view (sRGB) as `render_view` makes it, but for the footprints of parts, half their spacing; rays a pixel."""
    size = cameras.height * cameras.width
    pixels = torch.arange(view * size, (view + 1) * size)
    rays = cameras.image_rays(view)
    central = model.render(replace(rays, radii=torch.zeros_like(rays.radii)))
    beside = torch.cat(
        [model.exit_directions(neighbour_rays(cameras, some)) for some in pixels.split(model.chunk_size)]
    )
    shown, radiance = model.scene.colour_space.to_display(central.radiance), central.radiance.clone()
    divided = divergence(cameras, pixels, central.exit_directions, beside) >= subdivision.divergence
    divided |= contrast(lambda some: shown[some - pixels[0]], cameras, pixels) >= (subdivision.contrast or math.inf)
    side = subdivision.side
    for some in divided.nonzero()[:, 0].split(model.chunk_size // side**2):
        parts = part_rays(cameras, pixels[some], side)
        exits = model.exit_directions(parts).view(-1, side, side, 3)
        widths = 0.5 * torch.maximum(*(spacing(exits, axis) for axis in (1, 2))).flatten()
        radiance[some] = model.render(replace(parts, radii=widths)).radiance.view(-1, side**2, 3).mean(1)
    return model.scene.colour_space.to_display(radiance), 2 + side**2 * float(divided.float().mean())


def spacing(directions: Float[Tensor, "*batch 3"], axis: int) -> Float[Tensor, "*batch"]:
    """Chords towards the neighbours before and after along an axis, the smaller of both: across an edge of the glass a
    neighbour says nothing about the own side of it. Those that are not a number are passed over."""
    steps = torch.linalg.vector_norm(directions.diff(dim=axis), dim=-1)
    none = torch.full_like(steps.narrow(axis, 0, 1), float("nan"))
    return torch.fmin(torch.cat([none, steps], axis), torch.cat([steps, none], axis))


class View:
    """The glass's pixels of a view: exits of their parts, and their true colours."""

    def __init__(self, cameras: Cameras, view: int, medium: SdfGrid, pyramid: Pyramid) -> None:
        self._cameras, self._pyramid = cameras, pyramid
        self._snell, self._medium = Snell(), medium
        size = cameras.height * cameras.width
        every = torch.arange(view * size, (view + 1) * size)
        own = self._trace(pixel_rays(cameras, every))
        fine = self._trace(part_rays(cameras, every, 4))
        self._central, self._first = own[0], view * size
        self.pixels = every[fine[1].view(-1, 16).any(-1)]
        self._exits: dict[int, Tensor] = {}
        truth = torch.cat([
            pyramid(self._trace(part_rays(cameras, some, TRUTH))[0]).view(-1, TRUTH**2, 3).mean(1)
            for some in self.pixels.split(2048)
        ])  # fmt: skip
        self.truth = to_srgb(truth).clamp(0, 1)

    def _trace(self, rays: Rays) -> tuple[Tensor, Tensor]:
        rays = replace(rays, far=torch.full_like(rays.far, 30.0))
        paths = [self._snell(rays[i : i + CHUNK], self._medium) for i in range(0, len(rays), CHUNK)]
        return torch.cat([p.exit_directions for p in paths]), torch.cat([p.refracted for p in paths])

    def exits(self, side: int) -> Tensor:
        """Directions [P, side, side, 3] in which the rays of equal parts leave."""
        if side not in self._exits:
            found = self._trace(part_rays(self._cameras, self.pixels, side))[0]
            # `part_rays` goes through places (x, y) with y fastest.
            self._exits[side] = found.view(-1, side, side, 3)
        return self._exits[side]

    def widths(self, side: int) -> Tensor:
        """Widths [P, side, side] of the footprints of parts, radians: the larger of their spacings along two axes."""
        cameras, pixels = self._cameras, self.pixels
        height, width = cameras.height * side, cameras.width * side
        image = torch.full((height, width, 3), float("nan"))
        local = pixels - self._first
        row, column = local // cameras.width, local % cameras.width
        ticks = torch.arange(side)
        rows = (row[:, None, None] * side + ticks[None, None, :]).expand(-1, side, side)
        columns = (column[:, None, None] * side + ticks[None, :, None]).expand(-1, side, side)
        image[rows, columns] = self.exits(side)
        both = [spacing(image, axis) for axis in (0, 1)]
        return torch.fmax(*both).nan_to_num(0.0)[rows, columns]

    def colours(self, side: int, scale: float | None) -> Tensor:
        """Linear radiance [P, side * side, 3] of parts."""
        exits = self.exits(side).reshape(-1, 3)
        widths = None if scale is None else scale * self.widths(side).reshape(-1)
        return self._pyramid(exits, widths).view(len(self.pixels), side * side, 3)

    def mean(self, side: int, scale: float | None) -> Tensor:
        return self.colours(side, scale).mean(1)

    def divided(self) -> tuple[Tensor, Tensor]:
        """Which pixels of the glass, and of all, `evaluation` divides: rays part by 1.5 pixels, or colours by 0.1."""
        cameras = self._cameras
        shown = to_srgb(self._pyramid(self._central)).clamp(0, 1)
        every = torch.arange(self._first, self._first + len(shown))
        result = contrast(lambda some: shown[some - self._first], cameras, every) >= 0.1
        result |= divergence(cameras, every, self._central, self._trace(neighbour_rays(cameras, every))[0]) >= 1.5
        return result[self.pixels - self._first], result

    def as_evaluated(self, side: int, scale: float | None, divided: Tensor) -> Tensor:
        """All parts of divided pixels, and one ray for the others."""
        return torch.where(divided[:, None], self.mean(side, scale), self.mean(1, scale))

    def neighbourhood(self, values: Tensor) -> Tensor:
        """Mean of the glass's pixels among the nine around each, of one value for each pixel."""
        cameras = self._cameras
        local = self.pixels - self._first
        image = torch.zeros(2, cameras.height * cameras.width)
        image[0, local], image[1, local] = values, 1.0
        sums = torch.nn.functional.avg_pool2d(image.view(1, 2, cameras.height, -1), 3, 1, 1).view(2, -1)[:, local]
        return sums[0] / sums[1]


def by_need(views: list[View], budget: float, scale: float | None) -> tuple[list[Tensor], float]:
    """Four rays for every pixel, then as many as their spread asks for: the means, and the mean number of rays."""
    spreads = []
    for view in views:
        shown = to_srgb(view.colours(2, scale)).clamp(0, 1)
        spread = shown.std(1).square().mean(-1).sqrt()
        spreads.append(0.5 * spread + 0.5 * view.neighbourhood(spread))
    all_spreads = torch.cat(spreads)
    # The error of a mean falls with the number of rays, at best with its power 3/4 on a lattice: rays in proportion to
    # the spread are near the least sum of squares.
    low, high = 0.0, 1e5
    for _ in range(40):
        factor = 0.5 * (low + high)
        rays = _cost(_sides(all_spreads, factor)).mean()
        low, high = (factor, high) if rays <= budget else (low, factor)
    means = []
    for view, spread in zip(views, spreads, strict=True):
        sides, mean = _sides(spread, low), view.mean(2, scale)
        for side in SIDES[2:]:
            mean = torch.where((sides == side)[:, None], view.mean(side, scale), mean)
        means.append(mean)
    return means, float(_cost(_sides(all_spreads, low)).mean())


def _sides(spread: Tensor, factor: float) -> Tensor:
    steps = torch.tensor(SIDES[1:], dtype=spread.dtype)
    wanted = (factor * spread).sqrt()
    return steps[(torch.bucketize(wanted, 0.5 * (steps[1:] + steps[:-1])))]


def _cost(sides: Tensor) -> Tensor:
    """Rays of a pixel: the first four, and all its parts where it is divided further."""
    return 4 + torch.where(sides > 2, sides.square(), 0)


def score(views: list[View], means: list[Tensor]) -> float:
    errors = [
        (to_srgb(mean).clamp(0, 1) - view.truth).square().mean(-1) for view, mean in zip(views, means, strict=True)
    ]
    return -10 * math.log10(float(torch.cat(errors).mean()))


if __name__ == "__main__":
    main()
