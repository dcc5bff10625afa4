"""Measure accuracy and speed of tracing: `python benchmarks/tracing.py`, about five minutes on two cores.

Prints the tables of docs/results/benchmarks.md as Markdown; `--branches` prints only the last table. Errors are
measured against closed forms or an independent tracer. Speeds are the best of several passes that alternate between
samplers.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from rounded_cube import trace_rounded_cube
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.types import Rays
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.paper.eikonal import Eikonal
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.paths.snell import Snell
from tests.closed_forms import Ball, RoundedBox, angle, ball_exits, make_rays, sampled

RADIUS, N_BALL = 0.8, 1.5
HALF_SIDE, EDGE, N_CUBE = 0.75, 0.08, 1.52
NEAR, FAR = 2.0, 6.0
NUM_EULER_STEPS = 768
EULER = Eikonal("euler", NUM_EULER_STEPS)
BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])
CHUNK = 8192  # rays at once, as in evaluation
BINS = (("b/R < .5", 0.0, 0.5), (".5 to .8", 0.5, 0.8), (".8 to .95", 0.8, 0.951))

Trace = Callable[[Rays], Tensor]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=int, default=256, help="of the signed-distance grids")
    parser.add_argument("--branches", action="store_true", help="print only the cost of light that splits")
    parser.add_argument("--euler-resolution", type=int, default=512, help="of the paper's voxel grid (authors: 512)")
    parser.add_argument("--side", type=int, default=400, help="pixels of the view whose rays are timed")
    parser.add_argument("--rays", type=int, default=4000, help="rays through the ball; 3/8 of them through the cube")
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    with tempfile.TemporaryDirectory() as folder:
        ball, cube = Path(folder) / "ball.ply", Path(folder) / "cube.ply"
        sphere = trimesh.creation.icosphere(6, RADIUS)
        sphere.export(ball)
        rounded_cube_mesh().export(cube)
        if arguments.branches:
            solids = {"sphere": (ball, N_BALL), "cube": (cube, N_CUBE)}
            branches({name: make_bodies(str(mesh), n, resolution=arguments.resolution, cache=False)
                      for name, (mesh, n) in solids.items()}, arguments.side)  # fmt: skip
            return
        print(f"{torch.get_num_threads()} threads; ball of {len(sphere.faces)} faces\n")
        start = time.perf_counter()
        voxels = VoxelGrid(str(ball), N_BALL, arguments.euler_resolution, cache=False)
        built = time.perf_counter()
        mesh_ball = make_bodies(str(ball), N_BALL, resolution=arguments.resolution, cache=False)
        print(
            f"building from the mesh: {arguments.euler_resolution}^3 voxel grid {built - start:.1f} s, "
            f"{arguments.resolution}^3 signed distance {time.perf_counter() - built:.1f} s (compilation included)\n"
        )
        mesh_cube = make_bodies(str(cube), N_CUBE, resolution=arguments.resolution, cache=False)
        sphere_errors(voxels, mesh_ball, arguments.resolution, arguments.rays)
        cube_errors(mesh_cube, arguments.resolution, 3 * arguments.rays // 8)
        coarse = VoxelGrid(str(ball), N_BALL, arguments.resolution, cache=False)
        speed([voxels, coarse], {"sphere": mesh_ball, "cube": mesh_cube}, arguments.side)
        branches({"sphere": mesh_ball, "cube": mesh_cube}, arguments.side)
    print("\nThe compiled kernels trace on the CPU for rays on any device, so there are no separate times for a GPU.")


def sphere_errors(voxels: VoxelGrid, mesh_ball: Bodies, resolution: int, num: int) -> None:
    """Print errors of the exit direction against 2 (asin(b / R) - asin(b / (n R))), for rays of random directions."""
    generator = np.random.default_rng(0)
    d = generator.normal(size=(num, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    u = np.cross(d, generator.normal(size=(num, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    share = np.linspace(0, 0.95, num)
    rays = make_rays(u * share[:, None] * RADIUS - 4 * d, d, NEAR, FAR)
    exact = ball_exits(rays, RADIUS, N_BALL)
    analytic = Ball(RADIUS, N_BALL).double()
    exact_grid = sampled(grid_distances(analytic, resolution), BOX, [N_BALL], mesh_ball.shell)
    rows: list[tuple[str, Trace, tuple[float, ...] | None]] = [
        (
            f"euler, {NUM_EULER_STEPS} steps, {voxels.table.shape[0]}^3 voxels 9/1 (the paper's)",
            exits(EULER, voxels),
            None,
        ),
        (f"eikonal, {resolution}^3 signed distance", exits(Eikonal(), exact_grid), (0.05, 0.15, 1.0)),
        (f"eikonal, {resolution}^3 signed distance of the mesh", exits(Eikonal(), mesh_ball), (0.05, 0.15, 1.0)),
        ("snell, analytic signed distance", exits(Snell(), analytic), (0.001, 0.001, 0.001)),
        (f"snell, {resolution}^3 signed distance", exits(Snell(), exact_grid), (0.02, 0.05, 0.2)),
        (f"snell, {resolution}^3 signed distance of the mesh", exits(Snell(), mesh_ball), (0.02, 0.05, 0.2)),
        ("snell, mesh", exits(Snell("mesh"), mesh_ball), (0.02, 0.05, 0.2)),
    ]
    print(f"### Exit direction behind a glass ball (R {RADIUS}, n {N_BALL}), degrees: median (maximum)\n")
    print("| sampler | " + " | ".join(name for name, _, _ in BINS) + " | bound on the median | met |")
    print("|---|---|---|---|---|---|")
    for name, trace, bounds in rows:
        error = angle(trace(rays), exact).numpy()
        chosen = [error[(share >= low) & (share < high)] for _, low, high in BINS]
        cells = [f"{np.median(part):.4f} ({part.max():.3f})" for part in chosen]
        met = "" if bounds is None else verdict(all(np.median(p) <= b for p, b in zip(chosen, bounds, strict=True)))
        limit = "" if bounds is None else " / ".join(f"{bound:g}" for bound in bounds)
        print(f"| {name} | {' | '.join(cells)} | {limit} | {met} |", flush=True)


def cube_errors(mesh_cube: Bodies, resolution: int, num: int) -> None:
    """Print errors of the exit direction behind the rounded cube against the independent tracer.

    A ray is well-conditioned if its neighbours at 1e-4 units have as many reflections and leave within 0.5 degrees.
    """
    generator = np.random.default_rng(1)
    d = generator.normal(size=(num, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x = generator.uniform(-0.7, 0.7, (num, 3)) - 3.5 * d
    side = np.cross(d, generator.normal(size=(num, 3)))
    side *= 1e-4 / np.linalg.norm(side, axis=1, keepdims=True)
    shape = (HALF_SIDE, EDGE, N_CUBE)
    traces = [
        [trace_rounded_cube(p, q, *shape) for p, q in zip(start, d, strict=True)] for start in (x, x + side, x - side)
    ]
    exact, beside, opposite = (torch.tensor(np.stack([direction for direction, _ in trace])) for trace in traces)
    bounces = np.array([[count for _, count in trace] for trace in traces])
    same = (bounces == bounces[0]).all(0) & (bounces[0] >= 0) & (bounces[0] <= 3)
    moved = torch.maximum(angle(beside, exact), angle(opposite, exact))
    sound = same & (moved < 0.5).numpy()
    rays = make_rays(x, d, near=0.0, far=14.0)  # reflected paths are long
    analytic = RoundedBox(HALF_SIDE, EDGE, N_CUBE).double()
    grid = sampled(grid_distances(analytic, resolution), BOX, [N_CUBE], mesh_cube.shell)
    print(
        f"\n### Exit direction behind a rounded glass cube (half side {HALF_SIDE}, edge {EDGE}, n {N_CUBE}), degrees\n"
    )
    print(f"{sound.sum()} of {(bounces[0] >= 0).sum()} rays are well-conditioned with at most 3 total reflections, "
          f"{(sound & (bounces[0] > 0)).sum()} of them with any.\n")  # fmt: skip
    print("| sampler | median | 95th percentile | bound | met |\n|---|---|---|---|---|")
    for name, trace in (
        ("snell, analytic signed distance", exits(Snell(), analytic)),
        (f"snell, {resolution}^3 signed distance", exits(Snell(), grid)),
        (f"snell, {resolution}^3 signed distance of the mesh", exits(Snell(), mesh_cube)),
        ("snell, mesh", exits(Snell("mesh"), mesh_cube)),
        (f"eikonal, {resolution}^3 signed distance", exits(Eikonal(), grid)),
    ):
        error = angle(trace(rays), exact).numpy()[sound]
        median, high = np.median(error), np.quantile(error, 0.95)
        met = verdict(median <= 0.02 and high <= 0.5) if name.startswith("snell") else ""
        bound = "0.02 / 0.5" if name.startswith("snell") else ""
        print(f"| {name} | {median:.5f} | {high:.4f} | {bound} | {met} |", flush=True)


def speed(baselines: list[VoxelGrid], solids: dict[str, Bodies], side: int) -> None:
    """Print rays per second over all rays of a view, against Euler steps in the same kind of compiled kernel.

    The cost of Euler steps does not depend on the object. A smaller grid is faster, because more of it stays in caches.
    """
    print(f"\n### All {side}x{side} rays of a view, {CHUNK} at once\n")
    print("| object | sampler | ms | million rays/s | against the faster euler | bound | met |")
    print("|---|---|---|---|---|---|---|")
    rays = view(side).image_rays(0)
    for scene, solid in solids.items():
        rows: list[tuple[str, Trace, float]] = [
            *(
                (f"euler, {NUM_EULER_STEPS} steps, {grid.table.shape[0]}^3", exits(EULER, grid), 0.0)
                for grid in baselines
            ),
            ("eikonal", exits(Eikonal(), solid), 10.0),
            ("snell", exits(Snell(), solid), 20.0),
        ]
        best = fastest([partial(trace_all, trace, rays) for _, trace, _ in rows], 4, time.perf_counter)
        baseline = min(best[: len(baselines)])
        for (name, _, bound), seconds in zip(rows, best, strict=True):
            ratio = baseline / seconds
            limit, met = (f"{bound:g}x", verdict(ratio >= bound)) if bound else ("", "")
            rate = len(rays) / seconds / 1e6
            print(
                f"| {scene} | {name} | {1e3 * seconds:.0f} | {rate:.2f} | {ratio:.1f}x | {limit} | {met} |", flush=True
            )


def branches(solids: dict[str, Bodies], side: int) -> None:
    """Print the cost of light that splits for the same rays, in processor time because cores may be shared."""
    print(f"\n### Light that splits, all {side}x{side} rays of a view\n")
    print("| object | branches, least weight | paths a ray that meets it | ms | million rays/s | against one path |")
    print("|---|---|---|---|---|---|")
    rays = view(side).image_rays(0)
    samplers = {"none": Snell(), "first, 0.02": Snell(branches="first")}
    samplers |= {f"all, {least}": Snell(branches="all", least_weight=least) for least in (0.05, 0.02, 0.005)}
    for scene, solid in solids.items():
        traces = [partial(sampler, medium=solid) for sampler in samplers.values()]
        best = fastest([partial(trace_all, trace, rays) for trace in traces], 4, time.process_time)
        for name, trace, seconds in zip(samplers, traces, best, strict=True):
            refracted = torch.cat(
                [path.ray[path.refracted] + CHUNK * i for i, path in enumerate(in_chunks(trace, rays))]
            )
            paths = len(refracted) / len(refracted.unique())
            cost = f"{1e3 * seconds:.0f} | {1e-6 * len(rays) / seconds:.2f}"
            print(f"| {scene} | {name} | {paths:.2f} | {cost} | {seconds / best[0]:.2f}x |", flush=True)


def in_chunks(trace: Callable[[Rays], Any], rays: Rays) -> Iterator[Any]:
    """Trace rays in chunks, as in evaluation."""
    for first in range(0, len(rays), CHUNK):
        yield trace(rays[first : first + CHUNK])


def trace_all(trace: Callable[[Rays], object], rays: Rays) -> None:
    """Trace rays and discard the paths."""
    for _ in in_chunks(trace, rays):
        pass


def fastest(tasks: Sequence[Callable[[], object]], turns: int, clock: Callable[[], float]) -> list[float]:
    """Return the seconds of each task in its fastest turn; the first turn, which may compile, can only be slower."""
    best = [math.inf] * len(tasks)
    for _ in range(turns):
        for number, task in enumerate(tasks):
            start = clock()
            task()
            best[number] = min(best[number], clock() - start)
    return best


def exits(sampler: Eikonal | Snell, medium: torch.nn.Module) -> Trace:
    """Return a function that traces exit directions by a sampler."""
    return lambda rays: sampler(rays, medium).exit_directions


def grid_distances(shape: Ball | RoundedBox, resolution: int) -> Tensor:
    """Return the signed distances of a shape at the vertices of a grid."""
    axis = torch.linspace(-1.5, 1.5, resolution, dtype=torch.float64)
    planes = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)
    slices = [torch.cat([torch.full_like(planes[..., :1], float(x)), planes], -1) for x in axis]
    return torch.stack([shape.signed_distances(points)[0][..., 0].float() for points in slices])[None]


def rounded_cube_mesh(per_edge: int = 24, per_face: int = 8) -> trimesh.Trimesh:
    """Return a rounded cube with fine facets on edges and corners and coarse facets on the faces."""
    inner = HALF_SIDE - EDGE
    # Tangents spaced evenly in angle over the rounding, and evenly over the flat part.
    bend = inner + EDGE * np.tan(np.linspace(0, np.pi / 4, per_edge + 1)[1:])
    flat = np.linspace(-inner, inner, per_face + 1)
    line = np.concatenate([-bend[::-1], flat, bend])
    u, v = np.meshgrid(line, line, indexing="ij")
    square = np.stack([u, v, np.full_like(u, inner + EDGE)], -1).reshape(-1, 3)
    size = len(line)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).reshape(-1)
    faces = np.concatenate([
        np.stack([corner, corner + size, corner + size + 1], -1),
        np.stack([corner, corner + size + 1, corner + 1], -1),
    ])  # fmt: skip
    sides = []
    for axis in range(3):
        for sign in (1, -1):
            rotation = np.roll(np.eye(3), axis, axis=1) * sign
            rotation[0] *= sign * sign * np.sign(np.linalg.det(rotation))
            sides.append(trimesh.Trimesh(square @ rotation, faces, process=False))
    cube = trimesh.util.concatenate(sides)
    centre = cube.vertices.clip(-inner, inner)
    outward = cube.vertices - centre
    cube.vertices = np.round(centre + EDGE * outward / np.linalg.norm(outward, axis=1, keepdims=True), 9)
    cube.merge_vertices()
    cube.fix_normals()
    return cube


def view(side: int) -> Cameras:
    """Return a camera as in the synthetic scenes: 39.6 degrees wide, 4.03 units from the origin."""
    z = np.array([0.5, 0.6, 0.62]) / np.linalg.norm([0.5, 0.6, 0.62])
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    pose = torch.from_numpy(np.stack([x, np.cross(z, x), z, 4.03 * z], -1)[None]).float()
    focal, centre = torch.tensor([0.5 * side / math.tan(0.5 * 0.6911)]), torch.tensor([side / 2])
    return Cameras(pose, focal, focal, centre, centre, side, side, NEAR, FAR)


def verdict(met: bool) -> str:
    """Return the cell of a table."""
    return "yes" if met else "**no**"


if __name__ == "__main__":
    main()
