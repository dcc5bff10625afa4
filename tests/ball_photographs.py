"""Photographs of balls in balls under a smooth sky, all in closed form but for the grid of distances."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from nerfro.core.cameras import Cameras
from nerfro.core.light import to_srgb
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.files.images import save_png
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from tests.cameras_at import cameras_at, poses_towards_origin
from tests.closed_forms import grid_points, sampled

SIZE, NUM_VIEWS, RADIUS, INNER = 40, 30, 0.7, 0.35
SHARES = 5  # pixels of masks are divided by so many, each way
BOX = torch.tensor([[-0.9] * 3, [0.9] * 3])
TRANSMITTED = Snell()
# Overrides with which a training on photographs of a ball of index 1.45 takes seconds.
TRAINING = [
    "logger=none", "medium.cache=false", "medium.resolution=48", "medium.box_min=[-1,-1,-1]", "medium.box_max=[1,1,1]",
    "data.near=0.5", "background.resolutions=[4,8,16,32]", "batches.size=384", "evaluation.split=train",
    "sampler.points.num_samples=4", "sampler.points.num_bins=16", "sampler.points.resolution=16",
    "field.num_levels=2", "field.log2_table_size=8", "field.width=16", "loss.background.start=0", "evaluation.every=0",
    "trainer.accelerator=cpu", "trainer.max_time=null", "evaluation.subdivision.side=1", "batches.subdivision.side=1",
    "medium.ior=1.45",
]  # fmt: skip

# Overrides of a reconstruction of these photographs, and of its trainings.
RECONSTRUCTION = ["data=blender", "data.near=0.5", "medium.resolution=32", "preprocess=resolution=24"]
RECONSTRUCTION_TRAINING = [
    "evaluation.split=train", "evaluation.every=0", "evaluation.subdivision.side=1", "logger=none",
    "trainer.accelerator=cpu", "trainer.max_time=null", "batches.size=64", "background.resolutions=[4,8]",
    "field.num_levels=2", "field.log2_table_size=8", "sampler.points.num_samples=4", "sampler.points.resolution=16",
]  # fmt: skip


def cameras() -> Cameras:
    """Around the origin, looking at it."""
    index = np.arange(NUM_VIEWS) + 0.5
    z = 1 - 2 * index / NUM_VIEWS
    flat, turn = np.sqrt(1 - z * z), 2.4 * index
    back = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)
    return cameras_at(poses_towards_origin(back, 3.0, (0.3, 0.9, 0.1)), SIZE, SIZE, 0.8 * SIZE, near=0.5)


def soft_masks(mesh: TriangleMesh) -> Tensor:
    """Shares of pixels [V, H, W] that the cameras see filled by a mesh."""
    fine = mesh_silhouettes(mesh, cameras().resized(SHARES * SIZE, SHARES * SIZE), 1).float()
    return avg_pool2d(fine[:, None], SHARES)[:, 0]


def sky(directions: Tensor) -> Tensor:
    """Smooth linear radiance in [0.1, 0.9]."""
    x, y, z = directions.unbind(-1)
    waves = [(4 * x + 2 * y).sin() * (3 * z).cos(), (5 * y - 2 * z).sin(), (4 * z + 3 * x).cos() * (2 * y).sin()]
    return 0.5 + 0.4 * torch.stack(waves, -1)


def ball(radius: float) -> Tensor:
    points = grid_points(0.9, 41, torch.float64)
    return (points.norm(dim=-1) - radius).float()


def solid(iors: list[float], inner: float = INNER) -> Bodies:
    return sampled(torch.stack([ball(RADIUS), ball(inner)][: len(iors)]), BOX, iors, 0.01)


def photographs(iors: list[float], opaque: bool = False, inner: float = INNER) -> Views:
    """What the bodies show of the sky: their surfaces are those of balls, to a grid's accuracy."""
    return photographs_of(solid(iors, inner), opaque)


def photographs_of(
    medium: Bodies,
    opaque: bool = False,
    around: Callable[[Exits], Tensor] = lambda exits: sky(exits.directions),
    sampler: Snell = TRANSMITTED,
) -> Views:
    """What a medium shows of what is around it, the sky."""
    taken, images = cameras(), []
    for view in range(NUM_VIEWS):
        rays = taken.image_rays(view)
        path = medium.with_absorption(sampler(rays, medium))
        radiance = path.sum_polylines(around(path.exits()) * path.whole_transmittance())
        if opaque:  # painted, in every colour of the sky
            radiance = torch.where(path.refracted[:, None], sky(normalize(path.positions[:, 1], dim=-1)), radiance)
        images.append(to_srgb(radiance).view(SIZE, SIZE, 3))
    return Views(taken, torch.stack(images), None, [str(view) for view in range(NUM_VIEWS)])


def mesh() -> TriangleMesh:
    made = trimesh.creation.icosphere(5, RADIUS)
    return TriangleMesh(made.vertices, made.faces)


def save_with_masks(root: Path) -> None:
    """Write photographs of a glass ball of index 1.45 like `save`, and masks of shares of pixels."""
    save(photographs([1.45]), root)
    for view, mask in enumerate(soft_masks(mesh())):
        save_png(root / "masks" / "train" / f"r_{view}.png", mask[..., None].expand(-1, -1, 3))


def save(views: Views, root: Path, place: tuple[float, ...] = (0, 0, 0)) -> None:
    """Write a split `train` in Blender format, and the mesh of the larger ball, both moved to a place."""
    frames = []
    for view, image in enumerate(views.images):
        save_png(root / "train" / f"r_{view}.png", image)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3] = views.cameras.camera_to_world[view]
        pose[:3, 3] += torch.tensor(place, dtype=torch.float64)
        frames.append({"file_path": f"./train/r_{view}", "transform_matrix": pose.tolist()})
    angle = 2 * math.atan(0.5 * views.cameras.width / float(views.cameras.fx[0]))
    (root / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    mesh().relative_to(-np.array(place, np.float64)).save(root / "mesh.ply")
