"""How well the indices of a ball in a ball are found together, from nothing.

    python benchmarks/two_bodies.py [--size 96]

Photographs are in closed form but for the grid of distances. Prints a Markdown table; the smaller the difference of the
radii, the more rays cross both bodies, and the more the indices trade.
"""

from __future__ import annotations

import argparse
import time

from nerfro.capture.index_search import find_indices
from nerfro.capture.surroundings import divide_pixels, learn_surroundings
from tests import ball_photographs as balls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--size", type=int, default=96, help="pixels a side of the photographs")
    balls.SIZE = parser.parse_args().size
    print(f"{balls.NUM_VIEWS} photographs of {balls.SIZE}x{balls.SIZE} pixels; outer radius {balls.RADIUS}\n")
    print("| inner radius | true: outer, inner | found | error | processor time |\n|---|---|---|---|---|")
    for inner, iors in ((0.35, [1.5, 1.333]), (0.35, [1.333, 1.5]), (0.5, [1.5, 1.333]), (0.6, [1.52, 1.333])):
        views = balls.photographs(iors, inner=inner)
        start = time.process_time()
        beside, through = divide_pixels(views, balls.mesh())
        found = find_indices(balls.solid([1.5, 1.5], inner), through, learn_surroundings(beside, balls.mesh(), False))
        spent = time.process_time() - start
        each = list(zip(found.values, found.standard_errors, iors, strict=True))
        numbers = ", ".join(f"{value:.3f} ± {error:.4f}" for value, error, _ in each)
        shares = ", ".join(f"{abs(value / true - 1):.1%}" for value, _, true in each)
        doubts = "; in doubt" if found.doubts else ""
        print(f"| {inner} | {iors[0]}, {iors[1]} | {numbers}{doubts} | {shares} | {spent:.0f} s |", flush=True)


if __name__ == "__main__":
    main()
