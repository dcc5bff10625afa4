"""The figures of docs/concepts: `python benchmarks/optics_pictures.py`, about two minutes."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
import trimesh
from concept_figures import IMAGES, canvas
from tracing import BOX, EULER, FAR, N_BALL, NEAR, RADIUS, exits, grid_distances, view

from nerfro.core.cameras import central_window
from nerfro.core.light import to_srgb
from nerfro.core.paths import ASSETS_DIR
from nerfro.core.types import Path as RayPath
from nerfro.core.types import Rays
from nerfro.evaluation.path_plot import plot_paths
from nerfro.files import lat_long
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.paper.eikonal import Eikonal
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.subdivision import part_rays
from tests.closed_forms import Ball, RoundedBox, angle, ball_exits, make_rays, sampled

TILT = np.radians(33)
SLANTED = np.array([[np.cos(TILT), np.sin(TILT), 0.0]])


def beam_at(heights: np.ndarray) -> Rays:
    """Parallel rays along x through the ball."""
    return make_rays(np.stack([0 * heights - 4, heights, 0 * heights], -1), [[1.0, 0, 0]] * len(heights), 0.0, 12.0)


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=IMAGES)
    parser.add_argument("--resolution", type=int, default=256, help="of the grids")
    parser.add_argument("--side", type=int, default=260, help="pixels of a rendered picture")
    parser.add_argument("--light", action="store_true", help="only those of light that splits, is absorbed, disperses")
    arguments = parser.parse_args()
    folder = arguments.folder
    torch.set_grad_enabled(False)
    if arguments.light:
        draw_light(folder, arguments.side)
        return
    with tempfile.TemporaryDirectory() as temporary:
        mesh = Path(temporary) / "ball.ply"
        trimesh.creation.icosphere(6, RADIUS).export(mesh)
        voxels = VoxelGrid(str(mesh), N_BALL, arguments.resolution, cache=False)
    draw_paths(voxels, folder / "optics_paths.png")
    draw_errors(voxels, folder / "optics_error.png", arguments.resolution)
    draw_light(folder, arguments.side)


def draw_light(folder: Path, side: int) -> None:
    """Light that splits, is absorbed and disperses: paths, and an empty cube under the torus scene's sky."""
    beam = beam_at(np.linspace(-0.7, 0.7, 7))
    into_cube = make_rays(-4 * SLANTED + 0.1, SLANTED, 0.0, 12.0)
    splitting = Snell(branches="all", least_weight=0.002)
    clear, green, flint = (
        cube_of_distances(**options)
        for options in ({}, {"absorption": [1.2, 0.25, 0.8]}, {"abbe": 8.0})  # type: ignore[arg-type]
    )
    ball = Ball(RADIUS, N_BALL).double()
    flint_ball = sampled(grid_distances(ball, 128), BOX, [N_BALL], 0.02, abbe=8.0)
    pictures: dict[str, tuple[RayPath, Medium, dict[str, np.ndarray]]] = {
        "optics_branches.png": (splitting(beam, ball), ball, {
            "one path": picture(Snell(), clear, side),
            "first reflection, F and 1 - F": picture(Snell(branches="first"), clear, side),
            "all branches of 2 % or more": picture(Snell(branches="all"), clear, side),
        }),
        "optics_tint.png": (Snell(branches="all")(into_cube, clear), clear, {
            "clear": picture(Snell(branches="all"), clear, side),
            "absorption 1.2, 0.25, 0.8": picture(Snell(branches="all"), green, side),
        }),
        "optics_dispersion.png": (Snell()(beam[-1:], flint_ball), flint_ball, {
            "one index": picture(Snell(branches="all"), clear, side),
            "Abbe number 8, three bands": picture(Snell(branches="all"), flint, side),
            "the same, nine bands": picture(
                Snell(branches="all", wavelengths=[640, 610, 580, 565, 545, 525, 490, 465, 440]), flint, side
            ),
        }),
    }  # fmt: skip
    for name, (path, medium, shown) in pictures.items():
        figure = canvas(3.6 * (1 + len(shown)), 3.9)
        axes = figure.subplots(1, 1 + len(shown))
        plot_paths(axes[0], path, medium)
        for panel, (title, image) in zip(axes[1:], shown.items(), strict=True):
            panel.imshow(image, interpolation="nearest")
            panel.set_title(title, fontsize=11)
            panel.axis("off")
        figure.savefig(folder / name, dpi=90, bbox_inches="tight")


def cube_of_distances(**options: object) -> Bodies:
    """A rounded cube of glass on a grid, for the compiled kernel."""
    values = grid_distances(RoundedBox(0.7, 0.1).double(), 128)
    return sampled(values, BOX, [1.5], 0.02, **options)


def picture(sampler: Snell, medium: Bodies, side: int, parts: int = 3) -> np.ndarray:
    """The medium under the sky of the scene `torus`, several rays a pixel, sRGB."""
    cameras = view(side).crop(central_window(side, side, 0.75))
    radiance_of_sky = lat_long.load_lat_long(ASSETS_DIR / "torus" / "sky.png")
    radiance = []
    for pixels in torch.arange(cameras.width * cameras.height).split(8192):
        path = medium.with_absorption(sampler(part_rays(cameras, pixels, parts), medium))
        light = lat_long.sample(radiance_of_sky, path.exit_directions, width=4096) * path.whole_transmittance()
        radiance.append(path.sum_polylines(light).view(-1, parts**2, 3).mean(1))
    return to_srgb(torch.cat(radiance)).clamp(0, 1).view(cameras.height, cameras.width, 3).numpy()


def draw_paths(voxels: VoxelGrid, file: Path) -> None:
    """A beam through a ball and a cube by Snell's law, and through the ball by the paper's tracker."""
    figure = canvas(13, 4.6)
    axes = figure.subplots(1, 3)
    beam = beam_at(np.linspace(-0.78, 0.78, 19))
    offsets = np.linspace(-0.55, 0.3, 8)[:, None] * np.array([[-np.sin(TILT), np.cos(TILT), 0.0]])
    into_cube = make_rays(offsets - 4 * SLANTED, np.repeat(SLANTED, 8, 0), 0.0, 12.0)
    panels: list[tuple[str, Medium, RayPath]] = [
        ("snell, ball of n 1.5", Ball(RADIUS, N_BALL).double(), Snell()(beam, Ball(RADIUS, N_BALL).double())),
        (
            "euler, 768 steps, 256^3 voxels",
            voxels,
            Eikonal("euler", 768)(make_rays(beam.origins, beam.directions, NEAR, FAR), voxels),
        ),
        ("snell, rounded cube of n 1.52", RoundedBox().double(), Snell()(into_cube, RoundedBox().double())),
    ]
    for panel, (title, medium, path) in zip(axes, panels, strict=True):
        plot_paths(panel, path, medium)
        panel.set(title=title, xlim=(-1.3, 1.7), ylim=(-1.5, 1.5))
    figure.savefig(file, dpi=90)


def draw_errors(voxels: VoxelGrid, file: Path, resolution: int) -> None:
    """Error of the exit direction against the impact parameter."""
    figure = canvas(7.5, 4.6)
    axes = figure.subplots()
    share = np.linspace(0.01, 0.99, 400)
    turn = np.random.default_rng(0).normal(size=(400, 3))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    side = np.cross(turn, np.random.default_rng(1).normal(size=(400, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rays = make_rays(side * share[:, None] * RADIUS - 4 * turn, turn, NEAR, FAR)
    exact = ball_exits(rays, RADIUS, N_BALL)
    spacing = 3 / (resolution - 1)
    distances = grid_distances(Ball(RADIUS).double(), resolution)
    curves = [
        ("euler 768, voxels 9/1 (the paper's)", exits(EULER, voxels)),
        ("eikonal, the same voxels", exits(Eikonal(), voxels)),
    ]
    for shell in (0.5, 0.1):
        solid = sampled(distances, BOX, [N_BALL], shell * spacing)
        curves.append((f"eikonal, signed distance, shell {shell} voxels", exits(Eikonal(), solid)))
    curves.append(("snell, signed distance", exits(Snell(), solid)))
    curves.append(("snell, analytic", exits(Snell(), Ball(RADIUS, N_BALL).double())))
    for name, trace in curves:
        axes.semilogy(share, angle(trace(rays), exact).clip(1e-6), ".", markersize=3, label=name)
    axes.axhline(0.1, color="grey", linewidth=0.8)
    axes.text(1.0, 0.07, "one pixel of 400", color="grey", fontsize=8, ha="right", va="top")
    axes.set_xlabel("impact parameter b / R")
    axes.set_ylabel("error of the exit direction, degrees")
    axes.set_title(f"Glass ball, R {RADIUS}, n {N_BALL}, {resolution}^3 grids")
    axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 0.04))
    figure.savefig(file, dpi=90)


if __name__ == "__main__":
    main()
