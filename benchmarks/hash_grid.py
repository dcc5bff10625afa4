"""Hash-grid field, environment map and density grid: compiled CPU kernels against reference implementations.

    python benchmarks/hash_grid.py [--rays 1024] [--samples 64] [--threads 2] [--rounds 9] [--cpu-time]

Prints a Markdown table. Both implementations alternate within one run, and the fastest round of each counts. On a busy
machine, use `--threads 1 --cpu-time` to measure processor time instead of elapsed time.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from datetime import date
from functools import partial

import torch
from torch import Tensor, nn
from tracing import fastest

from nerfro.boundaries import cube_map
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.draws import Draws
from nerfro.fields import hash_encoding
from nerfro.fields.hash_grid import HashGridField
from nerfro.fields.spherical_harmonics import spherical_harmonics
from nerfro.kernels.allocator import keep_freed_memory
from nerfro.media.analytic import Vacuum
from nerfro.samplers.paths.straight import Straight
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.types import Exits, Rays, Samples

Task = Callable[[], object]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--cpu-time", action="store_true", help="processor time instead of elapsed time")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    keep_freed_memory()  # as training does
    print(
        f"{platform.processor() or platform.machine()}, {arguments.threads} threads, torch {torch.__version__}, ",
        end="",
    )
    print(
        f"{date.today()}, {arguments.rays} rays x {arguments.samples} samples, fastest of {arguments.rounds} turns, ",
        end="",
    )
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    print("processor time\n" if arguments.cpu_time else "elapsed time\n")
    print("| task | reference, ms | compiled, ms | ratio |\n|---|---|---|---|")
    samples = random_samples(arguments.rays, arguments.samples)
    for num_levels, log2_table_size in ((12, 15), (16, 15), (16, 17)):
        name = f"{num_levels} levels, 2^{log2_table_size} entries"
        for label, reference, compiled in hash_grid_tasks(samples, num_levels, log2_table_size):
            report(f"{label}; {name}", reference, compiled, arguments.rounds, clock)
    for label, reference, compiled in [*environment_map_tasks(arguments.rays), *drawing_tasks(arguments.rays)]:
        report(label, reference, compiled, arguments.rounds, clock)


def random_samples(num_rays: int, num_samples: int) -> Samples:
    """Straight rays through the box [-1, 1]^3, all samples inside."""
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 1, 3), dim=-1).expand(-1, num_samples, -1)
    edges = torch.linspace(0, 1, num_samples + 1).expand(num_rays, -1)
    positions = 0.5 * (2 * torch.rand(num_rays, 1, 3) - 1) + directions * (edges[:, :-1, None] - 0.5)
    return Samples(positions, directions.contiguous(), edges[:, :-1], edges, torch.zeros(num_rays))


class TwinField(HashGridField):
    """The field in plain PyTorch on the CPU, too: its encodings, and MLPs differentiated by autograd."""

    def encode(self, positions: Tensor) -> Tensor:
        return hash_encoding.hash_encode((positions - self.box_min) / self.side, self.table, self.levels)

    def encode_directions(self, directions: Tensor) -> Tensor:
        return spherical_harmonics(directions, self.direction_bands)

    def apply_mlp(self, mlp: nn.Sequential, *inputs: Tensor) -> Tensor:
        return mlp(torch.cat(inputs, dim=-1))


def hash_grid_tasks(samples: Samples, num_levels: int, log2_table_size: int) -> list[tuple[str, Task, Task]]:
    """Encoding alone, and a whole training pass through the field (forward, backward, Adam)."""
    settings = {"num_levels": num_levels, "finest_resolution": 512, "log2_table_size": log2_table_size}
    compiled = HashGridField(**settings, precision="bfloat16")
    reference = TwinField(**settings, precision="float32")
    upstream = torch.randn(samples.positions.shape[0] * samples.positions.shape[1], 2 * num_levels)
    positions = samples.positions.flatten(0, 1)

    def encode(field: HashGridField) -> Task:
        return lambda: field.encode(positions)

    def encode_and_back(field: HashGridField) -> Task:
        return lambda: torch.autograd.grad(field.encode(positions), field.table, upstream)

    def decode(field: HashGridField) -> Task:
        parameters = list(field.parameters())

        def run() -> None:
            radiance = field(samples)
            torch.autograd.grad(radiance.density.sum() + radiance.rgb.square().sum(), parameters)

        return run

    def adam(field: HashGridField, fused: bool) -> Task:
        optimiser = torch.optim.Adam(field.parameters(), fused=fused)
        for parameter in field.parameters():
            parameter.grad = torch.randn_like(parameter)
        return optimiser.step

    same = HashGridField(**settings, precision="float32")
    return [
        ("encode, forward", encode(reference), encode(compiled)),
        ("encode, forward and backward", encode_and_back(reference), encode_and_back(compiled)),
        ("encode + decode in float32, forward and backward", decode(reference), decode(same)),
        ("encode + decode in bfloat16, forward and backward", decode(reference), decode(compiled)),
        ("Adam (plain, fused)", adam(reference, fused=False), adam(compiled, fused=True)),
    ]


def environment_map_tasks(num_rays: int) -> list[tuple[str, Task, Task]]:
    """Lookup with gradient, and what the whole boundary costs in a step."""
    boundary = EnvironmentMap()
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3), dim=-1)

    def reference() -> None:
        raw = cube_map.lookup(*cube_map.project(directions), boundary.texels, boundary.padded, boundary.levels)
        torch.autograd.grad(torch.sigmoid(raw).square().sum(), boundary.texels)

    def compiled() -> None:
        torch.autograd.grad(boundary(Exits(directions)).square().sum(), boundary.texels)

    return [("environment map, one direction a ray, forward and backward", reference, compiled)]


def drawing_tasks(num_rays: int) -> list[tuple[str, Task, Task]]:
    """Samples of straight rays past a ball, drawn from a grid with a few dense cells."""
    origin = torch.nn.functional.normalize(torch.randn(3), dim=-1) * 2.2
    directions = torch.nn.functional.normalize(0.9 * torch.randn(num_rays, 3) - origin, dim=-1)
    near, far = torch.full((num_rays,), 0.5), torch.full((num_rays,), 4.0)
    path = Straight()(Rays(origin.expand_as(directions), directions, torch.zeros(num_rays), near, far), Vacuum())
    tasks = []
    for label, options in (
        ("a box, 32 samples of 96 bins", {"resolution": 64}),
        ("all of space, 16 samples of 128 bins", {"radius": 1.0, "resolution": 96, "num_bins": 128, "num_samples": 16}),
    ):
        sampler = DensityGridSampler(**options)
        sampler.density = 20 * torch.rand(sampler.density.shape) ** 8
        draws = Draws(0, 0, torch.arange(num_rays))
        reference, compiled = partial(sampler.draw, path, draws), partial(sampler.draw_compiled, path, draws)
        tasks.append((f"drawing in {label}", reference, compiled))
    return tasks


def report(label: str, reference: Task, compiled: Task, rounds: int, clock: Callable[[], float]) -> None:
    """Print a table row; both tasks run once before they are timed."""
    slow, fast = (1e3 * seconds for seconds in fastest([reference, compiled], rounds + 1, clock))
    print(f"| {label} | {slow:.2f} | {fast:.2f} | {slow / fast:.1f}x |", flush=True)


if __name__ == "__main__":
    main()
