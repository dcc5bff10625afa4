"""Compare costs of training with the reported costs of other programs, in processor time on one thread.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/peers.py

The figures of other programs are those of a report of November 2026 (`REPORTED`), which measured them beside nerfro on
one thread. This script does not run the other programs. It measures nerfro on the embedded scene, and prints both
figures and their ratio as Markdown.
"""

from __future__ import annotations

import argparse
import resource
import statistics

from training import MESH, PLAIN, Training, paper_recipe

from nerfro.kernels.available import keep_freed_memory

AUTHORS = "authors' code (jax 0.10.2), index grid of 256^3"
# Quantity, program, and the lowest and highest reported value.
REPORTED = (
    ("step", AUTHORS, 8.1, 8.1),
    ("memory", AUTHORS, 6.2, 6.2),
    ("rays", AUTHORS, 1024 / 8.1, 1024 / 8.1),
    ("rays", "Eikonal Fields, stage that learns the index", 438, 438),
    ("rays", "nerfacto, in PyTorch", 380, 530),
)


def main() -> None:
    """Measure nerfro and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paper-steps", type=int, default=4, help="number of steps with the recipe of the paper")
    parser.add_argument("--steps", type=int, default=60, help="number of steps with the default configuration")
    parser.add_argument("--turns", type=int, default=3, help="number of measurements, of which the fastest counts")
    parser.add_argument("--paper-options", nargs="+", default=[], help="options of nerfro.train for the paper's recipe")
    parser.add_argument("--options", nargs="+", default=[], help="options of nerfro.train for the default")
    options = parser.parse_args()
    keep_freed_memory()  # as nerfro.train does
    step = seconds_per_step(paper_recipe(PLAIN, *options.paper_options), options.paper_steps, options.turns)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9  # Linux counts in KiB
    training = Training(MESH, *options.options)
    rays = training.num_rays / seconds_per_step(training, options.steps, options.turns)
    measured = {
        "step": (f"seconds per step of 1024 rays, `{PLAIN}`", step),
        "memory": (f"peak memory in GB, `{PLAIN}`", memory),
        "rays": ("training pixels or rays per second, default configuration", rays),
    }
    print("| quantity of nerfro | nerfro | other program | reported | nerfro / other |\n|---|---|---|---|---|")
    for name, program, low, high in REPORTED:
        quantity, ours = measured[name]
        reported = between(low, high, ".0f" if low > 100 else ".1f")
        ratio = between(ours / high, ours / low, ".2f" if ours < 10 * low else ".0f")
        print(f"| {quantity} | {ours:,.{0 if ours > 100 else 1}f} | {program} | {reported} | {ratio} |")


def between(low: float, high: float, form: str) -> str:
    """Write a range of numbers, or one number if both are equal."""
    return f"{low:{form}}" if low == high else f"{low:{form}} to {high:{form}}"


def seconds_per_step(training: Training, num_steps: int, turns: int) -> float:
    """Return the mean processor time of a step in the fastest turn.

    The first step of a turn does not count, because it allocates memory and compiles kernels.
    """
    return min(statistics.mean(training.run(num_steps).processor[1:]) for _ in range(turns))


if __name__ == "__main__":
    main()
