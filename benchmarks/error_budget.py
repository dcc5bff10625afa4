"""Assign the squared error of a trained run to classes of pixels, and print the PSNR without the error of each class.

    python benchmarks/error_budget.py RUN [--views 5] [--divergence 0]

RUN is a run folder. Its first test views are rendered again, as in its evaluation or with other numbers of rays, and
every pixel is assigned to the first class that it fits.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import nerfro
from nerfro.core.cameras import Cameras
from nerfro.evaluation.render_view import render_view
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import divergence, neighbour_rays, pixel_rays

CLASSES = ("background beside the glass", "objects inside", "edges", "background through the glass")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--views", type=int, help="number of test views; all by default")
    for option, kind in (("side", int), ("divergence", float), ("contrast", float)):
        parser.add_argument(f"--{option}", type=kind, help=f"evaluation.subdivision.{option}; as trained by default")
    parser.add_argument("--edge", type=float, default=8.0, help="divergence of an edge, in pixel angles")
    arguments = parser.parse_args()
    scene = nerfro.load(arguments.run, device="cpu")
    model, views = scene.renderer, scene.views().checked()
    wanted = {name: getattr(arguments, name) for name in ("side", "divergence", "contrast")}
    subdivision = replace(scene.subdivision, **{name: value for name, value in wanted.items() if value is not None})
    errors, classes = [], []
    for view in range(min(len(views), arguments.views or len(views))):
        rendered = render_view(model, views.cameras, view, subdivision)
        prediction = model.scene.colour_space.to_display(rendered.radiance)
        errors.append((prediction - views.images[view].reshape(-1, 3)).square().mean(-1))
        classes.append(classify(model, views.cameras, view, rendered.opacity, arguments.edge))
    print(f"{arguments.run}, {len(errors)} test views, {subdivision.side}^2 rays in divided pixels\n")
    print("| pixels | share of pixels | share of squared error | PSNR of these | PSNR of all if these were perfect |")
    print("|---|---|---|---|---|")
    for row in budget(torch.cat(errors), torch.cat(classes)):
        print(f"| {row} |")


@torch.inference_mode()
def classify(model: Renderer, cameras: Cameras, view: int, opacity: Tensor, edge: float) -> Tensor:
    """Row of CLASSES for each pixel of a view."""
    size = cameras.height * cameras.width
    parted, refracted = [], []
    for pixels in torch.arange(view * size, (view + 1) * size).split(model.chunk_size):
        own, beside = (model.trace(rays(cameras, pixels)) for rays in (pixel_rays, neighbour_rays))
        leaving = [path.main_polyline(path.exit_directions) for path in (own, beside)]
        parted.append(divergence(cameras, pixels, *leaving) >= edge)
        refracted.append(own.main_polyline(own.refracted))
    order = (~torch.cat(refracted) & ~torch.cat(parted), opacity >= 0.5, torch.cat(parted))
    result = torch.full_like(opacity, len(order), dtype=torch.int64)
    for index in reversed(range(len(order))):
        result[order[index]] = index
    return result


def budget(errors: Tensor, classes: Tensor) -> Iterator[str]:
    """A row of the table for each class, and one for all pixels."""
    total = errors.double().sum()
    for index, name in enumerate((*CLASSES, "all")):
        chosen = classes == index if index < len(CLASSES) else torch.ones_like(classes, dtype=torch.bool)
        part = errors[chosen].double().sum()
        without = "" if name == "all" else f"{decibels((total - part) / len(errors)):.2f}"
        of_these = decibels(part / chosen.sum().clamp(min=1))
        yield f"{name} | {chosen.float().mean():.0%} | {part / total:.0%} | {of_these:.2f} | {without}"


def decibels(mean_square: Tensor) -> float:
    """Peak signal-to-noise ratio of a mean squared error of values in [0, 1]."""
    return -10 * math.log10(max(float(mean_square), 1e-12))


if __name__ == "__main__":
    main()
