"""Compare a visual hull with the true surface: `python benchmarks/hull.py DATA MESH`, one minute on one core."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from capture import align_to_truth, transformed, volume_overlap
from jaxtyping import Float

from nerfro.camera.refined.refined import Similarity
from nerfro.core.paths import resolve_path
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.registry.registration import discover, find
from nerfro.samplers.paths.snell import Snell
from nerfro.silhouettes.silhouettes import pixel_stride
from tests.exact_silhouettes import volume

_MARGIN_SHARE = 0.15
_MAX_PIXELS = 160


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", help="folder of posed images; the test split is used")
    parser.add_argument("mesh", type=Path, help="written by nerfro.preprocess")
    parser.add_argument("--truth", type=Path, help="true surface; DATA/truth/mesh.ply, or DATA/mesh.ply, if not given")
    parser.add_argument("--format", default="blender", help="of the data, as in data=")
    parser.add_argument("--ior", type=float, default=1.5)
    given = parser.parse_args()
    discover()
    views = find("data", given.format).cls(given.data).load("test")
    root = resolve_path(given.data)
    true = load_mesh(given.truth) if given.truth else true_surface(root)
    for name, value in measure(load_mesh(given.mesh), true, views, given.ior).items():
        print(f"{name:<60} {value:.4g}")


def true_surface(root: Path) -> TriangleMesh:
    """Return the true surface in the frame of the data set's cameras; for captures, cameras are estimated."""
    if not (root / "truth").is_dir():
        return load_mesh(root / "mesh.ply")
    scale, rotation, shift = align_to_truth(root, root)
    from_truth = Similarity(1 / scale, rotation.T, -rotation.T @ shift / scale)
    return transformed(load_mesh(root / "truth" / "mesh.ply"), from_truth)


def measure(mesh: TriangleMesh, true: TriangleMesh, views: Views, ior: float) -> dict[str, float]:
    """Compare a surface with the true one.

    Args:
        mesh: the surface.
        true: the true one, in the same frame.
        views: whose rays are traced through both.
        ior: refractive index inside.
    """
    both = np.concatenate([mesh.bounds, true.bounds])
    margin = _MARGIN_SHARE * np.ptp(both, axis=0).max()
    box = np.stack([both.min(0) - margin, both.max(0) + margin])
    ours, exact = (_medium(body, box, ior) for body in (mesh, true))
    stride = pixel_stride(views.cameras, _MAX_PIXELS)
    cameras = views.cameras.resized(views.cameras.width // stride, views.cameras.height // stride)
    errors = []
    for view in range(len(cameras)):
        rays = cameras.image_rays(view)
        seen, expected = (Snell()(rays, medium) for medium in (ours, exact))
        hit = expected.refracted
        errors.append(_degrees(seen.exit_directions[hit].numpy(), expected.exit_directions[hit].numpy()))
    error = np.concatenate(errors)
    tilt, area = normal_errors(mesh, exact)
    return {
        "volume, intersection over union": volume_overlap(mesh, true),
        "volume, ratio": volume(mesh) / volume(true),
        "normals, mean error in degrees": float((tilt * area).sum() / area.sum()),
        "exit directions, median error in degrees": float(np.median(error)),
        "exit directions, mean error in degrees": float(error.mean()),
    }


def normal_errors(mesh: TriangleMesh, exact: Bodies) -> tuple[Float[np.ndarray, "F"], Float[np.ndarray, "F"]]:
    """Return the angle of each triangle to the nearest true surface in degrees, and its area."""
    a, b, c = mesh.triangles.swapaxes(0, 1)
    gradient = exact.signed_distances(torch.from_numpy(mesh.triangles.mean(1)).float())[1][:, 0].double().numpy()
    normals = np.cross(b - a, c - a)
    return _degrees(normals, gradient), 0.5 * np.linalg.norm(normals, axis=1)


def _medium(mesh: TriangleMesh, box: Float[np.ndarray, "2 3"], ior: float) -> Bodies:
    with tempfile.TemporaryDirectory() as folder:
        mesh.save(file := Path(folder) / "mesh.ply")
        return make_bodies(str(file), ior, box_min=box[0].tolist(), box_max=box[1].tolist(), cache=False)


def _degrees(first: Float[np.ndarray, "N 3"], second: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Return angles between vectors; small angles are accurate."""
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.degrees(np.arctan2(across, (first * second).sum(1)))


if __name__ == "__main__":
    main()
