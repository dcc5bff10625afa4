"""Measure errors of calibration and visual hull of a simulated capture: `python benchmarks/capture.py DIR`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.camera.refined.refined import Similarity, motion_between, similarity
from nerfro.core.errors import NerfroError
from nerfro.data.transforms import find_splits, read_manifest
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.geometry.occupancy import occupancy_fraction

_RESOLUTION = 160


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="written by nerfro.synthesize, nerfro.calibrate, nerfro.preprocess")
    parser.add_argument("--data", type=Path, help="folder written by nerfro.calibrate, if it is another folder")
    given = parser.parse_args()
    for name, value in measure(given.folder, given.data or given.folder).items():
        print(f"{name:<52} {value:.4g}")


def measure(folder: Path, data: Path) -> dict[str, float]:
    """Compare estimated cameras and surface with the true ones.

    Args:
        folder: holds `truth/`.
        data: holds the estimated cameras in the format `opencv`, and perhaps mesh.ply and calibration.json.

    Raises:
        NerfroError: there are no cameras, or fewer than three.
    """
    lens, true_poses = read_cameras(folder / "truth")
    found_lens, _ = read_cameras(data)
    found, true = matched_poses(folder, data)
    to_truth = _fit_centres(found, true)
    angles, shifts = (values.numpy() for values in motion_between(to_truth.apply(found), true))
    true, moved = true.numpy(), to_truth.apply(found).numpy()
    surface = load_mesh(folder / "truth" / "mesh.ply")
    distance = np.linalg.norm(true[:, :, 3] - surface.bounds.mean(0), axis=1)
    offsets = shifts / distance
    pixels = np.linalg.norm(
        _project(surface.vertices[::50], found_lens, moved) - _project(surface.vertices[::50], lens, true), axis=-1
    )
    figures = {
        "photographs with a pose": len(found),
        "photographs": len(true_poses),
        "focal length, error in %": 100 * abs(found_lens[0, 0] / lens[0, 0] - 1),
        "principal point, error in pixels": float(np.linalg.norm(found_lens[:2, 2] - lens[:2, 2])),
        "rotation, median error in degrees": float(np.median(angles)),
        "rotation, largest error in degrees": float(angles.max()),
        "position, median error in % of the distance": 100 * float(np.median(offsets)),
        "position, largest error in % of the distance": 100 * float(offsets.max()),
        "object's surface in the pictures, median error in pixels": float(np.median(pixels)),
    }
    if (data / "calibration.json").is_file():
        report = json.loads((data / "calibration.json").read_text())
        figures["reprojection, mean over photographs in pixels"] = float(
            np.mean([image["error"] for image in report["images"].values()])
        )
    if (data / "mesh.ply").is_file():
        hull = transformed(load_mesh(data / "mesh.ply"), to_truth)
        figures["hull, intersection over union with the object"] = volume_overlap(hull, surface)
    return figures


def align_to_truth(folder: Path, data: Path) -> Similarity:
    """Fit the similarity transformation from the estimated world to the true one by the centres of the cameras.

    Args:
        folder: holds `truth/`.
        data: holds the estimated cameras in the format `opencv`.

    Raises:
        NerfroError: there are fewer than three estimated cameras, or one of them has no true pose.
    """
    return _fit_centres(*matched_poses(folder, data))


def matched_poses(folder: Path, data: Path) -> tuple[Float[Tensor, "V 3 4"], Float[Tensor, "V 3 4"]]:
    """Return the estimated poses and the true poses of the same photographs, see `align_to_truth`."""
    true, found = (read_cameras(root)[1] for root in (folder / "truth", data))
    if len(found) < 3:
        raise NerfroError(f"{data} has {len(found)} cameras; the alignment needs three or more")
    if unknown := sorted(found.keys() - true.keys()):
        raise NerfroError(f"{folder / 'truth'} has no pose of {unknown[0]}")
    estimated, exact = (torch.from_numpy(np.stack([poses[name] for name in sorted(found)])) for poses in (found, true))
    return estimated, exact


def _fit_centres(found: Float[Tensor, "V 3 4"], true: Float[Tensor, "V 3 4"]) -> Similarity:
    weights = torch.ones(len(true), dtype=true.dtype)
    return similarity(found, true, 0 * weights, weights)


def transformed(mesh: TriangleMesh, similarity: Similarity) -> TriangleMesh:
    """Transform the vertices of a mesh by a similarity transformation."""
    scale, rotation, shift = (values.numpy() for values in similarity)
    return TriangleMesh((scale * mesh.vertices @ rotation.T + shift).astype(mesh.vertices.dtype), mesh.faces)


def read_cameras(root: Path) -> tuple[Float[np.ndarray, "3 3"], dict[str, Float[np.ndarray, "3 4"]]]:
    """Read the camera matrix of a data set in the format `opencv`, and the poses of all its splits by file name.

    The folders differ, because frames of a video are copies of the photographs.
    """
    poses: dict[str, Float[np.ndarray, "3 4"]] = {}
    matrix = np.eye(3)
    for split in find_splits(root):
        manifest = read_manifest(root, split)
        matrix = np.array(manifest.document["cam_mat"], np.float64)
        poses |= {frame.image.name: np.asarray(frame.camera_to_world) for frame in manifest.frames}
    return matrix, poses


def volume_overlap(first: TriangleMesh, second: TriangleMesh) -> float:
    """Return the intersection over union of two closed bodies."""
    both = np.concatenate([first.bounds, second.bounds])
    margin = 0.02 * np.ptp(both, axis=0).max()
    box = np.stack([both.min(0) - margin, both.max(0) + margin])
    one, other = (occupancy_fraction(mesh, box, _RESOLUTION) > 0.5 for mesh in (first, second))
    return float((one & other).sum() / (one | other).sum())


def _project(
    points: Float[np.ndarray, "P 3"], lens: Float[np.ndarray, "3 3"], poses: Float[np.ndarray, "N 3 4"]
) -> Float[np.ndarray, "N P 2"]:
    """Project points to the pixels of cameras with OpenCV axes."""
    seen = np.einsum("npi,nij->npj", points - poses[:, None, :, 3], poses[:, :, :3]) @ lens.T
    return seen[..., :2] / seen[..., 2:]


if __name__ == "__main__":
    main()
