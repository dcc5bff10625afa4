"""Compare straight with bent rays behind water surfaces, walls of tanks, and panes.

`python benchmarks/water.py` builds the four media of the guide `docs/guides/water.md`. From all eyes, it aims at points
of the content, and prints by how much the bent rays miss these points, in millimetres.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
import yaml

import nerfro
from nerfro.media.body_settings import make_bodies

GUIDE = Path(__file__).parent.parent / "docs" / "guides" / "water.md"
# Corners of the content, lowest and highest elevation of the eyes in degrees, and their distance, in metres.
VIEWS = {
    "tank": ([[-0.2, -0.08, -0.15], [0.2, 0.08, 0.1]], (0, 30), 1.5),
    "pool": ([[-0.4, -0.4, -0.5], [0.4, 0.4, -0.4]], (35, 80), 2.0),
    "case": ([[-0.1, -0.1, -0.2], [0.1, 0.1, 0.0]], (0, 45), 1.5),
    "jar": ([[-0.03, -0.03, 0.02], [0.03, 0.03, 0.09]], (0, 30), 0.5),
}


def media_of_the_guide() -> dict[str, dict[str, dict[str, object]]]:
    """Return the bodies of each scene in the commands of the guide, by the folder of the data set."""
    commands = re.findall(r'data\.root=data/(\w+) [^\n]*"bodies=(\{.*?\})"', GUIDE.read_text(encoding="utf-8"))
    return {name: yaml.safe_load(bodies) for name, bodies in commands}


def misses(name: str, bodies: dict[str, dict[str, object]], num_rays: int) -> np.ndarray:
    """Return the distances [R] by which bent rays miss the points of the content at which they aim, metres."""
    generator = np.random.default_rng(0)
    box, elevations, distance = VIEWS[name]
    low, high = np.array(box)
    targets = low + generator.random((num_rays, 3)) * (high - low)
    azimuth = 2 * np.pi * generator.random(num_rays)
    elevation = np.radians(elevations[0] + (elevations[1] - elevations[0]) * generator.random(num_rays))
    across = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    eyes = 0.5 * (low + high) + distance * np.stack(across, -1)
    medium = make_bodies(bodies=bodies, cache=False)
    paths = nerfro.polylines(medium, eyes, targets - eyes, interface="mesh")
    return np.array([_distance(path, target) for path, target in zip(paths, targets, strict=True)])


def _distance(path: np.ndarray, point: np.ndarray) -> float:
    """Return the distance of a point from a polyline."""
    start, step = path[:-1], np.diff(path, axis=0)
    share = ((point - start) * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-30)
    return float(np.linalg.norm(start + share.clip(0, 1)[:, None] * step - point, axis=-1).min())


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=2000)
    number = parser.parse_args().rays
    media = media_of_the_guide()
    for name in VIEWS:
        errors = 1000 * misses(name, media[name], number)
        print(f"| {name} | {np.median(errors):.1f} | {np.quantile(errors, 0.9):.1f} |")


if __name__ == "__main__":
    main()
