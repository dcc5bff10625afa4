"""Export of a point cloud: the points at which bent rays of the training cameras meet the content."""

from __future__ import annotations

from pathlib import Path

import torch
import trimesh
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.images import to_8bit
from nerfro.light import to_srgb
from nerfro.subdivision import pixel_rays
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import query_field

_MIN_OPACITY = 0.5  # of a ray that contributes a point
_MAX_RAYS_PER_POINT = 100
# An outlier is a point whose neighbour of this rank is so many times as far away as for the median point.
_NEIGHBOURS, _OUTLIER_DISTANCE = 16, 3.0
_EXCESS = 1.2  # ratio of found to requested points, because outliers are removed


def write_points(scene: TrainedScene, out: Path, count: int) -> str:
    """Write points with 8-bit sRGB colours as .ply."""
    positions, radiance = find_points(scene, count)
    cloud = trimesh.PointCloud(positions.numpy(), colors=to_8bit(to_srgb(radiance)).numpy())
    write_atomically(out, cloud.export(file_type="ply"))
    return f"{len(positions)} points inside"


@torch.inference_mode()
def find_points(scene: TrainedScene, count: int, seed: int = 0) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Find the positions of maximum weight along the bent rays of random training pixels.

    Returns:
        Positions in world units, and linear radiance.

    Raises:
        NerfroError: no ray meets dense content.
    """
    renderer, cameras = scene.renderer, scene.cameras("train")
    generator = torch.Generator().manual_seed(seed)
    positions: list[Tensor] = []
    radiance: list[Tensor] = []
    found = 0
    with tqdm(total=count, unit="point", unit_scale=True, desc="export", dynamic_ncols=True) as progress:
        for _ in range(max(1, _MAX_RAYS_PER_POINT * count // renderer.chunk_size)):
            pixels = torch.randint(len(cameras) * cameras.height * cameras.width, (renderer.chunk_size,),
                                   generator=generator)  # fmt: skip
            rendering = renderer(pixel_rays(cameras, pixels.to(renderer.scene.device)))[-1]
            heaviest = rendering.weights.argmax(-1, keepdim=True)
            # Only the main polyline of a ray that splits contributes.
            opaque = rendering.path.first_of_ray(rendering.weights.sum(-1) > _MIN_OPACITY)
            samples = rendering.path.at(rendering.samples.s.gather(1, heaviest))
            points, directions = (rendering.path.first_of_ray(values[:, 0])[opaque] for values in samples)
            rgb = query_field(scene.field, points, directions)[1]
            positions.append(points.cpu())
            radiance.append(renderer.scene.colour_space.to_linear(rgb).cpu())
            found += len(points)
            progress.update(min(len(points), count - progress.n))
            if found >= _EXCESS * count:
                break
    if not found:
        raise NerfroError("no ray of the training cameras loses half its light inside; there are no points to write")
    kept = _without_outliers(torch.cat(positions))
    return torch.cat(positions)[kept][:count], torch.cat(radiance)[kept][:count]


def _without_outliers(positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Select points with near neighbours; isolated points are artefacts that explain the edges of the glass."""
    from scipy.spatial import cKDTree

    if len(positions) <= _NEIGHBOURS:
        return torch.ones(len(positions), dtype=torch.bool)
    distance = torch.from_numpy(cKDTree(positions.numpy()).query(positions.numpy(), [_NEIGHBOURS + 1])[0][:, 0])
    return distance <= _OUTLIER_DISTANCE * distance.median()
