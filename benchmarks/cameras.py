"""Measure how well training recovers disturbed poses and a disturbed lens: `python benchmarks/cameras.py`.

Every training camera of a scene is rotated about a random axis and shifted in a random direction, without the motion
common to all cameras, because that motion is not observable. Poses of test cameras stay exact, and the lens is
disturbed for all cameras. Each row is a run of `nerfro.train`, with the errors of the estimated cameras.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.camera.refined import refined
from nerfro.camera.refined.refined import motion_between, rotation_matrices
from nerfro.core.cameras import Cameras
from nerfro.core.paths import resolve_path
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.results import read_metrics_json
from nerfro.registry.registration import discover

discover()


def main() -> None:
    """Train with true poses, with disturbed ones, and with disturbed ones that are refined; print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", default="embedded:torus", help="folder in Blender format, with a mesh")
    parser.add_argument("--degrees", type=float, default=0.5, help="by which each camera is turned")
    parser.add_argument("--percent", type=float, default=1.0, help="of its distance, by which each camera is shifted")
    parser.add_argument("--focal", type=float, default=0.0, help="percent by which the focal length is too large")
    parser.add_argument("--principal", type=float, default=0.0, help="pixels by which the principal point is off")
    parser.add_argument("--seed", type=int, default=0, help="of the disturbance")
    parser.add_argument("--out", help="folder for the runs; removed in the end if none is given")
    parser.add_argument("--rows", nargs="+", default=["true", "disturbed", "refined"], help="which runs")
    parser.add_argument("options", nargs="*", help="of nerfro.train, for all runs")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        out = Path(given.out or folder).resolve()
        true = BlenderData(given.root).load("train").cameras
        initial = replace(
            true,
            camera_to_world=disturbed(true, math.radians(given.degrees), given.percent / 100, given.seed),
            fx=true.fx * (1 + given.focal / 100),
            fy=true.fy * (1 + given.focal / 100),
            cx=true.cx + given.principal,
            cy=true.cy - given.principal,
        )
        data = write_disturbed(resolve_path(given.root), initial, out / "data")
        disturbed_data = [f"data.root={data}", "data=nerfstudio", f"data.near={true.near:g}", f"data.far={true.far:g}"]
        lens = "true" if given.focal or given.principal else "false"
        print(
            "poses          PSNR   on the object   aligned   rotation, degrees    position, % of the distance   "
            "focal length, %   principal point, pixels\n"
            "                                                 median   largest     median   largest",
            flush=True,
        )
        for row in given.rows:
            run = out / row
            source = [f"data.root={given.root}"] if row == "true" else disturbed_data
            camera = ["camera=refined", f"camera.lens={lens}"] if row.startswith("refined") else []
            options = [*source, *camera, *given.options, f"hydra.run.dir={run}", "logger=none"]
            subprocess.run([sys.executable, "-m", "nerfro.train", *options], check=True, stdout=subprocess.DEVNULL)
            print(line(row, run, true, true if row == "true" else initial), flush=True)


def disturbed(cameras: Cameras, angle: float, share: float, seed: int) -> Float[Tensor, "V 3 4"]:
    """Rotate poses by an angle (radians) and shift them by a fraction of the distance, without common motion."""
    generator = torch.Generator().manual_seed(seed)
    poses, distances = cameras.camera_to_world.double(), refined.object_distances(cameras)
    units = torch.stack([torch.full_like(distances, angle), share * distances], -1).repeat_interleave(3, -1)
    axes = torch.randn(len(cameras), 2, 3, generator=generator, dtype=torch.float64)
    weights = refined.even_weights(refined.pixel_motions(cameras, distances))
    motion = torch.nn.functional.normalize(axes, dim=-1).flatten(1) * units
    motion = refined.project_out_gauge(motion, refined.gauge_basis(poses, weights), weights)
    axes = poses[..., :3]
    return torch.cat([axes @ rotation_matrices(motion[:, :3]), poses[..., 3:] + axes @ motion[:, 3:, None]], -1)


def write_disturbed(root: Path, cameras: Cameras, folder: Path) -> Path:
    """Write a copy of a data set in nerfstudio's format with other training cameras.

    The lens of the first camera replaces the lens of all splits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lens = {"fl_x": cameras.fx, "fl_y": cameras.fy, "cx": cameras.cx, "cy": cameras.cy}
    for path in root.iterdir():
        if not path.name.startswith("transforms_"):
            if not (folder / path.name).exists():
                os.symlink(path, folder / path.name)
            continue
        document = json.loads(path.read_text("utf-8")) | {name: float(values[0]) for name, values in lens.items()}
        for frame in document["frames"]:
            if "mask_path" in frame:  # in nerfstudio's format it says what to ignore
                frame["object_mask_path"] = frame.pop("mask_path")
        if path.name == "transforms_train.json":
            for frame, pose in zip(document["frames"], cameras.camera_to_world.tolist(), strict=True):
                frame["transform_matrix"] = [*pose, [0.0, 0.0, 0.0, 1.0]]
        (folder / path.name).write_text(json.dumps(document))
    return folder


def line(row: str, run: Path, true: Cameras, initial: Cameras) -> str:
    """Format a row of the table, with the cameras of the run if the run refined them, else the initial ones."""
    poses = initial.camera_to_world.double()
    true_lens, lens = ([float(values[0]) for values in (each.fx, each.cx, each.cy)] for each in (true, initial))
    if row.startswith("refined"):
        frames = json.loads((run / "cameras.json").read_text("utf-8"))["frames"]
        poses = torch.tensor([frame["transform_matrix"][:3] for frame in frames], dtype=torch.float64)
        lens = [frames[0][name] for name in ("fl_x", "cx", "cy")]
    result = read_metrics_json(run / "metrics.json")
    turn, shift = errors(poses, true)
    aligned = result.treatments.get("aligned")
    return (
        f"{row:<12} {result.result.mean('psnr'):6.2f} {decibels(result.result.mean('psnr', 'mask')):>15} "
        f"{decibels(aligned.mean('psnr') if aligned else None):>9} {turn.median():10.3f} {turn.max():9.3f} "
        f"{shift.median():10.3f} {shift.max():9.3f} {100 * (lens[0] / true_lens[0] - 1):17.3f} "
        f"{math.dist(lens[1:], true_lens[1:]):25.3f}"
    )


def decibels(psnr: float | None) -> str:
    """Format a PSNR, or a dash if there is none."""
    return "-" if psnr is None else f"{psnr:.2f}"


def errors(poses: Float[Tensor, "V 3 4"], true: Cameras) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """Return each camera's rotation error in degrees and position error in percent of the distance."""
    turn, shift = motion_between(true.camera_to_world, poses)
    return turn, 100 * shift / refined.object_distances(true)


if __name__ == "__main__":
    main()
