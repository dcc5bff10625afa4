"""Compare straight with bent rays behind water surfaces, walls of tanks, and panes.

`python benchmarks/water.py` builds the four media of the guide `docs/guides/water.md`. From all eyes, it aims at points
of the content, and prints by how much the bent rays miss these points, in millimetres.

`python benchmarks/water.py --folder DIR` synthesizes photographs of a tank, a pool and a jar, trains on each of them
with bent rays, and again with an index of 1, and prints the scores of the test views.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from trimesh.exchange.gltf import export_glb

import nerfro
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.media.body_settings import make_bodies
from nerfro.synthetic.options import SynthesizeConfig, ViewCounts
from nerfro.synthetic.synthesis import synthesize

ROOT = Path(__file__).parent.parent
GUIDE = ROOT / "docs" / "guides" / "water.md"
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


def _box(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def _cylinder(radius: float, low: float, high: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, high - low, sections=96).apply_translation([0, 0, 0.5 * (low + high)])


def _basin() -> list[trimesh.Trimesh]:
    """Return floor and walls of a basin of 1 x 1 x 0.5 m below the height 0."""
    walls = [_box([-0.52, side, -0.5], [0.52, side + 0.02, -0.005]) for side in (-0.52, 0.5)]
    across = [
        wall.copy().apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])) for wall in walls
    ]
    return [_box([-0.52, -0.52, -0.52], [0.52, 0.52, -0.5]), *walls, *across]


# Bodies with their indices, from the outside to the inside, and opaque contents, in metres.
SCENES: dict[str, tuple[dict[str, tuple[trimesh.Trimesh, float]], list[trimesh.Trimesh]]] = {
    "tank": (
        {
            "glass": (_box([-0.3, -0.15, -0.18], [0.3, 0.15, 0.18]), 1.52),
            "water": (_box([-0.294, -0.144, -0.174], [0.294, 0.144, 0.174]), 1.333),
        },
        [
            _box([-0.28, -0.13, -0.165], [0.28, 0.13, -0.12]),
            *(
                trimesh.creation.icosphere(4, 0.05).apply_translation(c)
                for c in ([0.15, 0.04, 0.02], [-0.05, -0.05, 0.1])
            ),
            trimesh.creation.torus(0.06, 0.025).apply_translation([-0.17, 0.02, -0.04]),
        ],
    ),
    "pool": (
        {"water": (_box([-0.55, -0.55, -0.55], [0.55, 0.55, 0]), 1.333)},
        [*_basin(), trimesh.creation.icosphere(4, 0.12).apply_translation([0.2, -0.1, -0.38])],
    ),
    "jar": (
        {"glass": (_cylinder(0.045, 0, 0.13), 1.52), "alcohol": (_cylinder(0.042, 0.004, 0.126), 1.361)},
        [
            trimesh.creation.torus(0.018, 0.008).apply_translation([0, 0, 0.06]),
            trimesh.creation.icosphere(4, 0.012).apply_translation([0.01, 0.01, 0.095]),
        ],
    ),
}


def write_scene(name: str, path: Path) -> None:
    """Write a scene of `SCENES` as a glTF file, with cells of random colours on the contents."""
    bodies, contents = SCENES[name]
    generator, scene, turn = np.random.default_rng(0), trimesh.Scene(), np.eye(4)
    turn[:3, :3] = Z_UP_TO_Y_UP
    palette = generator.integers(20, 236, (211, 3), dtype=np.uint8)
    for body, (mesh, _) in bodies.items():
        scene.add_geometry(mesh, geom_name=body, node_name=body, transform=turn)
    for number, mesh in enumerate(contents):
        cell = 0.15 * np.ptp(next(iter(bodies.values()))[0].bounds, axis=0).min()
        fine = mesh.subdivide_to_size(0.3 * cell)
        cells = np.floor(fine.vertices / cell + 100).astype(int) @ [1, 37, 1009] % len(palette)
        fine.visual.vertex_colors = palette[cells]
        scene.add_geometry(fine, geom_name=f"content{number}", node_name=f"content{number}", transform=turn)
    opaque = {"name": "opaque", "pbrMetallicRoughness": {"metallicFactor": 0.0}}

    def add(tree: dict[str, Any]) -> None:
        volume = {
            "KHR_materials_transmission": {"transmissionFactor": 1.0},
            "KHR_materials_volume": {"thicknessFactor": 1.0},
        }
        smooth = {"metallicFactor": 0.0, "roughnessFactor": 0.0}
        tree["materials"] = [opaque] + [
            {"name": body, "pbrMetallicRoughness": smooth, "extensions": volume | {"KHR_materials_ior": {"ior": ior}}}
            for body, (_, ior) in bodies.items()
        ]
        numbers = {body: 1 + number for number, body in enumerate(bodies)}
        for mesh in tree["meshes"]:
            mesh["primitives"][0]["material"] = numbers.get(mesh["name"], 0)

    path.write_bytes(export_glb(scene, tree_postprocessor=add))


def synthesize_scene(name: str, folder: Path, pixels: int = 80, spp: int = 32, num_views: int = 50) -> Path:
    """Render photographs of a scene of `SCENES`; returns the folder of the data set."""
    folder.mkdir(parents=True, exist_ok=True)
    write_scene(name, folder / f"{name}.glb")
    out = folder / name
    options = SynthesizeConfig(
        scene=str(folder / f"{name}.glb"), out=str(out), resolution=pixels, spp=spp, test_spp=4 * spp,
        views=ViewCounts(num_views, 1, 8), cameras="above" if name == "pool" else "orbit", sky_height=128, extras=False,
    )  # fmt: skip
    synthesize(options)
    return out


def compare(name: str, folder: Path, seconds: int) -> str:
    """Train on a synthesized scene with bent and with straight rays; returns a row of the table."""
    data = synthesize_scene(name, folder)
    scores: list[float] = []
    # The scene file of a single body sets `medium.ior`.
    names = [f"bodies.{body}.ior" for body in SCENES[name][0]] if len(SCENES[name][0]) > 1 else ["medium.ior"]
    for kind, options in (("bent", []), ("straight", [f"{setting}=1" for setting in names])):
        run = folder / f"{name}_{kind}"
        limit = f"trainer.max_time=00:00:{seconds // 60:02}:{seconds % 60:02}"
        command = [sys.executable, str(ROOT / "benchmarks" / "processor_time.py"), f"scene={data / 'scene.json'}"]
        command += ["sampler.path.interface=mesh", limit, f"hydra.run.dir={run}", *options]
        subprocess.run(command, check=True)
        metrics = json.loads((run / "metrics.json").read_text())
        scores += [metrics["test"]["psnr"], metrics["regions"]["mask"]["psnr"]]
    return f"| {name} | " + " | ".join(f"{score:.1f}" for score in scores) + " |"


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=2000)
    parser.add_argument("--folder", type=Path, help="train on synthesized photographs in this folder")
    parser.add_argument("--seconds", type=int, default=60, help="processor time of a training")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    arguments = parser.parse_args()
    if arguments.folder is not None:
        for name in arguments.scenes:
            print(compare(name, arguments.folder, arguments.seconds), flush=True)
        return
    number = arguments.rays
    media = media_of_the_guide()
    for name in VIEWS:
        errors = 1000 * misses(name, media[name], number)
        print(f"| {name} | {np.median(errors):.1f} | {np.quantile(errors, 0.9):.1f} |")


if __name__ == "__main__":
    main()
