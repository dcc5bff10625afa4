"""The pictures of docs/optics.md: `python benchmarks/optics_pictures.py`, about a minute."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tracing import BOX, N_BALL, RADIUS, angles, euler, exits, grid_distances, make_rays

from nerfro.evaluation.path_plot import plot_paths
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.shapes import Ball, RoundedBox
from nerfro.media.voxel_grid import VoxelGrid
from nerfro.samplers.eikonal import Eikonal
from nerfro.samplers.snell import Snell
from nerfro.types import Path as RayPath
from nerfro.types import Rays

RESOLUTION = 256
IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"


def main() -> None:
    """Draw both pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=IMAGES)
    folder = parser.parse_args().folder
    torch.set_grad_enabled(False)
    with tempfile.TemporaryDirectory() as temporary:
        mesh = Path(temporary) / "ball.ply"
        trimesh.creation.icosphere(6, RADIUS).export(mesh)
        voxels = VoxelGrid(str(mesh), N_BALL, RESOLUTION, cache=False)
    draw_paths(voxels, folder / "optics_paths.png")
    draw_errors(voxels, folder / "optics_error.png")


def draw_paths(voxels: VoxelGrid, file: Path) -> None:
    """A beam through a ball and a cube by Snell's law, and through the ball by the paper's tracker."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    heights = np.linspace(-0.78, 0.78, 19)
    beam = make_rays(np.stack([0 * heights - 4, heights, 0 * heights], -1), np.tile([[1.0, 0, 0]], (19, 1)), 0.0, 12.0)
    tilt = np.radians(33)
    slanted = np.array([[np.cos(tilt), np.sin(tilt), 0.0]])
    offsets = np.linspace(-0.55, 0.3, 8)[:, None] * np.array([[-np.sin(tilt), np.cos(tilt), 0.0]])
    into_cube = make_rays(offsets - 4 * slanted, np.repeat(slanted, 8, 0), 0.0, 12.0)
    panels: list[tuple[str, Medium, RayPath]] = [
        ("snell, ball of n 1.5", Ball(RADIUS, N_BALL).double(), Snell()(beam, Ball(RADIUS, N_BALL).double())),
        ("euler, 768 steps, 256^3 voxels", voxels, Eikonal("euler", 768)(_between(beam, 2.0, 6.0), voxels)),
        ("snell, rounded cube of n 1.52", RoundedBox().double(), Snell()(into_cube, RoundedBox().double())),
    ]
    for panel, (title, medium, path) in zip(axes, panels, strict=True):
        plot_paths(panel, path, medium)
        panel.set(title=title, xlim=(-1.3, 1.7), ylim=(-1.5, 1.5))
    figure.savefig(file, dpi=90)


def draw_errors(voxels: VoxelGrid, file: Path) -> None:
    """Error of the exit direction against the impact parameter."""
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    share = np.linspace(0.01, 0.99, 400)
    turn = np.random.default_rng(0).normal(size=(400, 3))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    side = np.cross(turn, np.random.default_rng(1).normal(size=(400, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    deviation = 2 * (np.arcsin(share) - np.arcsin(share / N_BALL))[:, None]
    exact = torch.from_numpy(turn * np.cos(deviation) - side * np.sin(deviation))
    rays = make_rays(side * share[:, None] * RADIUS - 4 * turn, turn)
    spacing = 3 / (RESOLUTION - 1)
    distances = grid_distances(Ball(RADIUS).double(), RESOLUTION)
    curves = [
        ("euler 768, voxels 9/1 (the paper's)", euler(voxels)),
        ("eikonal, the same voxels", exits(Eikonal(), voxels)),
    ]
    for shell in (0.5, 0.1):
        solid = SdfGrid.from_distances(distances, BOX, [N_BALL], shell * spacing)
        curves.append((f"eikonal, signed distance, shell {shell} voxels", exits(Eikonal(), solid)))
    curves.append(("snell, signed distance", exits(Snell(), solid)))
    curves.append(("snell, analytic", exits(Snell(), Ball(RADIUS, N_BALL).double())))
    for name, trace in curves:
        axes.semilogy(share, angles(trace(rays), exact).clip(1e-6), ".", markersize=3, label=name)
    axes.axhline(0.1, color="grey", linewidth=0.8)
    axes.text(1.0, 0.07, "one pixel of 400", color="grey", fontsize=8, ha="right", va="top")
    axes.set_xlabel("impact parameter b / R")
    axes.set_ylabel("error of the exit direction, degrees")
    axes.set_title(f"Glass ball, R {RADIUS}, n {N_BALL}, {RESOLUTION}^3 grids")
    axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 0.04))
    figure.savefig(file, dpi=90)


def _between(rays: Rays, near: float, far: float) -> Rays:
    return make_rays(rays.origins.numpy(), rays.directions.numpy(), near, far)


if __name__ == "__main__":
    main()
