"""Draw the figures of docs/concepts/{background,sampling,one_volume,inverse_problems}.md in a few minutes.

python benchmarks/concept_figures.py
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nerfro.capture.index_search import find_indices
from nerfro.capture.surroundings import divide_pixels, learn_surroundings
from nerfro.core.light import to_srgb
from nerfro.core.paths import ASSETS_DIR
from nerfro.core.types import Path as RayPath
from nerfro.data.formats.transforms import BlenderData
from nerfro.files import lat_long
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.geometry.space import Box, Contracted
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.points.stratified import Stratified

MESH = ASSETS_DIR / "torus" / "mesh.ply"
IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
BOX = [[-0.8] * 3, [0.8] * 3]
ROWS = {38: "tab:red", 64: "tab:orange", 90: "tab:cyan"}  # rows of the image, and colours of their marks
VIEW = 1


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=IMAGES)
    parser.add_argument("--downscale", type=float, default=1, help="factor of the photographs of the index search")
    options = parser.parse_args()
    folder = options.folder
    medium = make_bodies(str(MESH), 1.5, resolution=64)
    with torch.no_grad():
        draw_exits(medium, folder / "concept_background.png")
        draw_samples(medium, folder / "concept_sampling.png")
        draw_contraction(medium, folder / "concept_contraction.png")
    draw_index_search(BlenderData(downscale=options.downscale), folder / "concept_index.png")


def canvas(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def row_of_view(medium: Bodies, row: int) -> RayPath:
    """Trace the rays of a row of the embedded test view."""
    cameras = BlenderData().load("test").cameras
    columns = torch.arange(cameras.width)
    rays = cameras.rays(torch.full_like(columns, VIEW), torch.full_like(columns, row), columns)
    return Snell()(rays, medium)


def draw_exits(medium: Bodies, file: Path) -> None:
    """Show three rows of pixels, and the directions in which their rays leave the scene."""
    figure = canvas(11, 3.7)
    photograph, sky = figure.subplots(1, 2, width_ratios=(1, 2))
    photograph.imshow(BlenderData().load("test").images[VIEW])
    background = lat_long.load_lat_long(ASSETS_DIR / "torus" / "sky.png")
    sky.imshow(to_srgb(background).clamp(0, 1), extent=(180, -180, -90, 90), alpha=0.75)
    for row, colour in ROWS.items():
        path = row_of_view(medium, row)
        exits = path.exit_directions
        azimuth = torch.rad2deg(torch.atan2(exits[:, 1], exits[:, 0]))
        elevation = torch.rad2deg(torch.asin(exits[:, 2].clamp(-1, 1)))
        photograph.axhline(row, color=colour, linewidth=1.5)
        for chosen, marker in ((path.refracted, "o"), (~path.refracted, "_")):
            sky.scatter(azimuth[chosen], elevation[chosen], s=14, color=colour, marker=marker)
    photograph.set(title="three rows of a photograph")
    photograph.axis("off")
    sky.set(title="exit directions on the background", xlabel="azimuth, degrees", ylabel="elevation, degrees")
    figure.savefig(file, dpi=90)


def draw_samples(medium: Bodies, file: Path) -> None:
    """Compare samples of the density grid with even samples on a bent path through a torus of known density."""
    sampler = DensityGridSampler(Box(BOX), num_samples=32, uniform=0.2)
    cells = sampler.resolution
    centres = (torch.arange(cells) + 0.5) / cells * 1.6 - 0.8
    sampler.density.copy_(density(torch.stack(torch.meshgrid(centres, centres, centres, indexing="ij"), -1)))
    path = row_of_view(medium, 64)[torch.tensor([56])]
    drawn = {
        "even samples": Stratified(num_samples=32, space=Box(BOX))(path, None),
        "density grid": sampler(path, None),
    }
    near, far = float(drawn["even samples"].edges[0, 0]), float(drawn["even samples"].edges[0, -1])
    s = torch.linspace(near, far, 600)
    figure = canvas(8, 2.8)
    axes = figure.subplots()
    axes.fill_between(s, density(path.at(s[None])[0][0]) / 30, color="tab:blue", alpha=0.3, label="density")
    for height, (name, samples) in zip((-0.25, -0.55), drawn.items(), strict=True):
        axes.plot(samples.s[0], torch.full_like(samples.s[0], height), "|", markersize=11, label=name)
    axes.set(xlabel="arc length, world units", yticks=[], ylim=(-0.8, 1.2), xlim=(near, far))
    axes.legend(loc="upper right")
    figure.savefig(file, dpi=90)


def density(x: torch.Tensor) -> torch.Tensor:
    """Density of a torus around the z axis, per world unit."""
    ring = torch.linalg.vector_norm(x[..., :2], dim=-1) - 0.4
    return 30 * (ring.square() + x[..., 2].square() < 0.15**2)


def draw_contraction(medium: Bodies, file: Path) -> None:
    """Show a square grid and bent rays before and after contraction."""
    figure = canvas(9, 4.5)
    world, contracted = figure.subplots(1, 2)
    ticks, fine, radius = np.arange(-16, 16.1, 0.5), torch.linspace(-16, 16, 2001), 1.0
    space = Contracted([[-radius] * 3, [radius] * 3], radius)
    for tick in ticks:
        fixed = torch.full_like(fine, float(tick))
        for x, y in ((fine, fixed), (fixed, fine)):
            line = torch.stack([x, y, torch.zeros_like(x)], -1)
            for axes, points in ((world, line), (contracted, space.contract(line))):
                axes.plot(points[:, 0], points[:, 1], color="0.75", linewidth=0.5)
    path = row_of_view(medium, 64)[torch.arange(30, 100, 10)]
    s = torch.cat([torch.linspace(0, 20, 800), torch.logspace(math.log10(20), 4, 200)]).expand(len(path.s), -1)
    points = path.at(s)[0]
    points = points * torch.tensor([1.0, 1.0, 0.0])
    for axes, shown in ((world, points), (contracted, space.contract(points))):
        axes.plot(shown[..., 0].T, shown[..., 1].T, color="tab:red", linewidth=0.9)
        axes.add_patch(Circle((0, 0), radius, fill=False, color="tab:blue"))
        axes.set_aspect("equal")
    contracted.add_patch(Circle((0, 0), 2 * radius, fill=False, color="black"))
    world.set(title="world", xlim=(-5, 5), ylim=(-5, 5))
    contracted.set(title="contracted", xlim=(-2.1, 2.1), ylim=(-2.1, 2.1))
    figure.savefig(file, dpi=90)


def draw_index_search(data: BlenderData, file: Path) -> None:
    """Plot the error of candidate indices for the true surface of the embedded scene and for a scaled one."""
    mesh = load_mesh(MESH)
    beside, through = divide_pixels(data.load("train"), mesh)
    surroundings = learn_surroundings(beside, mesh, None)
    figure = canvas(7, 3.2)
    axes = figure.subplots()
    axes.axvline(1.5, color="0.6", linestyle=":", label="true index")
    with tempfile.TemporaryDirectory() as folder:
        for name, scale in (("true surface", 1.0), ("surface larger by 3 %", 1.03)):
            scaled = Path(folder) / f"{scale}.ply"
            TriangleMesh(scale * mesh.vertices, mesh.faces).save(scaled)
            found = find_indices(make_bodies(str(scaled), 1.5, cache=False), through, surroundings)
            label = f"{name}: {found.values[0]:.3f} ± {found.standard_errors[0]:.3f}"
            axes.plot(*found.coarse.T, "o-", markersize=3, linewidth=1, label=label)
    axes.set(xlabel="candidate index", ylabel="mean robust error")
    axes.legend()
    figure.savefig(file, dpi=90)


if __name__ == "__main__":
    main()
