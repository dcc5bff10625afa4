"""Points on what is inside, where bent rays of the training cameras meet it."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from nerfro.errors import NerfroError
from nerfro.files.images import to_8bit
from nerfro.files.ply import write_ply
from nerfro.light import to_srgb
from nerfro.subdivision import pixel_rays
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import ask

# Rays of which less light than this stops inside tell of nothing.
_SOLID = 0.5
# Rays are drawn until there are enough points, but no more than so many for each.
_PATIENCE = 100
# A point is alone where its neighbour of this number is so many times as far away as those of others.
_NEIGHBOURS, _ALONE = 16, 3.0
_SPARE = 1.2  # points that are looked for, for each that is wanted: some are alone


def write_points(scene: TrainedScene, out: Path, count: int) -> str:
    """Write points with colours (8-bit sRGB) as .ply."""
    positions, radiance = find_points(scene, count)
    colours = to_8bit(to_srgb(radiance)).numpy()
    columns = dict(zip(("red", "green", "blue"), colours.T, strict=True))
    write_ply(out, positions.numpy(), None, columns)
    return f"{len(positions)} points inside"


@torch.inference_mode()
def find_points(scene: TrainedScene, count: int, seed: int = 0) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Where rays of random training pixels lose most of their light, world units, and its linear radiance.

    Rays are followed through the glass, so that points lie where things are, and not where they seem to be.

    Raises:
        NerfroError: the rays meet nothing.
    """
    renderer, cameras = scene.renderer, scene.cameras("train")
    generator = torch.Generator().manual_seed(seed)
    positions: list[Tensor] = []
    radiance: list[Tensor] = []
    found = 0
    with tqdm(total=count, unit="point", unit_scale=True, desc="export", dynamic_ncols=True) as progress:
        for _ in range(max(1, _PATIENCE * count // renderer.chunk_size)):
            pixels = torch.randint(len(cameras) * cameras.height * cameras.width, (renderer.chunk_size,),
                                   generator=generator)  # fmt: skip
            rendering = renderer(pixel_rays(cameras, pixels.to(renderer.scene.device)))[-1]
            heaviest = rendering.weights.argmax(-1, keepdim=True)
            # Of light that splits, the main path alone.
            hit = rendering.path.first_of_ray(rendering.weights.sum(-1) > _SOLID)
            where, towards = rendering.path.at(rendering.samples.s.gather(1, heaviest))
            where, towards = (rendering.path.first_of_ray(values[:, 0])[hit] for values in (where, towards))
            positions.append(where.cpu())
            radiance.append(renderer.scene.colour_space.to_linear(ask(scene.field, where, towards)[1]).cpu())
            found += len(where)
            progress.update(min(len(where), count - progress.n))
            if found >= _SPARE * count:
                break
    if not found:
        raise NerfroError("no ray of the training cameras loses half its light inside; there are no points to write")
    dense = _in_company(torch.cat(positions))
    return torch.cat(positions)[dense][:count], torch.cat(radiance)[dense][:count]


def _in_company(positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Which points have neighbours as others have; the rest is what the field invents to explain edges of glass."""
    from scipy.spatial import cKDTree

    if len(positions) <= _NEIGHBOURS:
        return torch.ones(len(positions), dtype=torch.bool)
    distance = torch.from_numpy(cKDTree(positions.numpy()).query(positions.numpy(), [_NEIGHBOURS + 1])[0][:, 0])
    return distance <= _ALONE * distance.median()
