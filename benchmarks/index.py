"""How well the index is found, and from where: `python benchmarks/index.py DATA MESH --ior 1.5`.

The surface is spoiled more and more, by a coat of even thickness (or its lack) and by bumps, in shares of its size. For
each, what the search finds, and the basin: the starts from which the error only falls on the way to it.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from nerfro.capture.index_search import Estimate, find_indices
from nerfro.capture.surroundings import divide_pixels, learn_surroundings
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.media.sdf_grid import SdfGrid
from nerfro.paths import resolve_path
from nerfro.registry import discover, find

_BAND, _MARGIN_SHARE = 3.0, 0.2
# Bumps are sums of so many waves, of lengths from a third of the object's size to its size.
_WAVES = 12


def main() -> None:
    """Print a line for each spoiled surface."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", help="folder of posed images; its training split is looked at")
    parser.add_argument("mesh", help="closed surface")
    parser.add_argument("--format", default="blender", help="of the data, as in data=")
    parser.add_argument("--ior", type=float, default=1.5, help="the true one")
    parser.add_argument("--errors", type=float, nargs="+", default=[0, 0.5, 1, 2, 5], help="percent of the size")
    parser.add_argument("--resolution", type=int, default=128, help="of the surfaces' grids")
    given = parser.parse_args()
    discover()
    views = find("data", given.format).cls(given.data).load("train")
    mesh = load_mesh(resolve_path(given.mesh))
    beside, through = divide_pixels(views, mesh)
    surroundings = learn_surroundings(beside, mesh, None)
    print("surface                  index   error    standard error   falls from")
    for error in given.errors:
        for kind in ("coat", "lack", "bumps") if error else ("as given",):
            medium = _medium(spoiled(mesh, kind, error / 100), given.resolution)
            found = find_indices(medium, through, surroundings)
            low, high = basin(found)
            share = 100 * (found.values[0] / given.ior - 1)
            print(
                f"{kind:<9} {error:4.1f} %     {found.values[0]:9.4f} {share:+6.2f} % {found.standard_errors[0]:11.4f}"
                f"        {low:.2f} to {high:.2f}"
            )


def spoiled(mesh: TriangleMesh, kind: str, share: float) -> TriangleMesh:
    """A mesh moved along its normals by a share of its size, evenly or in bumps of that standard deviation."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    size = float(np.ptp(mesh.bounds, axis=0).max())
    height = np.full(len(mesh.vertices), {"coat": 1.0, "lack": -1.0}.get(kind, 0.0))
    if kind == "bumps":
        random = np.random.default_rng(0)
        waves = random.normal(size=(_WAVES, 3))
        waves *= 2 * np.pi * random.uniform(1, 3, (_WAVES, 1)) / size / np.linalg.norm(waves, axis=1, keepdims=True)
        height = np.sin(mesh.vertices @ waves.T + random.uniform(0, 2 * np.pi, _WAVES)).sum(1)
        height /= height.std()
    return TriangleMesh(mesh.vertices + share * size * height[:, None] * solid.vertex_normals, mesh.faces)


def basin(found: Estimate) -> tuple[float, float]:
    """Between which starts the error of a single body falls all the way to the lowest candidate."""
    values, errors = found.coarse.T
    low = high = int(errors.argmin())
    while low > 0 and errors[low - 1] > errors[low]:
        low -= 1
    while high + 1 < len(errors) and errors[high + 1] > errors[high]:
        high += 1
    return float(values[low]), float(values[high])


def _medium(mesh: TriangleMesh, resolution: int) -> SdfGrid:
    centre, half = mesh.bounds.mean(0), (0.5 + _MARGIN_SHARE) * np.ptp(mesh.bounds, axis=0).max()
    box: Float[np.ndarray, "2 3"] = np.stack([centre - half, centre + half])
    distances = torch.from_numpy(signed_distance_grid(mesh, box, resolution, _BAND)).float()[None]
    return SdfGrid.from_distances(distances, torch.from_numpy(box).float(), [1.5], 0.01)


if __name__ == "__main__":
    main()
