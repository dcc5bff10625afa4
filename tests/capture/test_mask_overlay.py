"""A known mesh, seen through the loaders' cameras, covers the masks."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.ray.ray_pyembree import RayMeshIntersector

from nerfro.data.base import Views
from nerfro.data.blender import BlenderData
from nerfro.data.opencv import OpenCVData
from nerfro.paths import resolve_path

SIZE = 64
FOCAL = 80.0


def silhouettes(views: Views, mesh: trimesh.Trimesh) -> torch.Tensor:
    """Pixels [V, H, W] whose ray meets the mesh."""
    intersector = RayMeshIntersector(mesh)
    hits = []
    for view in range(len(views)):
        rays = views.cameras.image_rays(view)
        hits.append(intersector.intersects_any(rays.origins.numpy(), rays.directions.numpy()))
    return torch.from_numpy(np.stack(hits)).reshape(-1, *views.images[0].shape[:2])


def intersection_over_union(ours: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
    """Of two masks [V, H, W], for each view."""
    both, either = (ours & theirs).sum((1, 2)), (ours | theirs).sum((1, 2))
    return both / either


def look_at(eye: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera-to-world matrix, OpenGL axes, of a camera at `eye` that sees the origin in the centre of its image."""
    backward = eye / np.linalg.norm(eye)
    right = np.cross(up, backward) / np.linalg.norm(np.cross(up, backward))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, eye], 1)
    return pose


def rasterise(mesh: trimesh.Trimesh, pose: np.ndarray, centre: tuple[float, float]) -> np.ndarray:
    """Mask [H, W] by projecting each triangle with K [R | t] and filling it at pixel centres, in float64."""
    x, y, z = np.linalg.inv(pose)[:3] @ np.c_[mesh.vertices, np.ones(len(mesh.vertices))].T
    corners = np.stack([centre[0] + FOCAL * x / -z, centre[1] - FOCAL * y / -z], -1)[mesh.faces]
    column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    pixels = np.stack([column, row], -1)
    mask = np.zeros((SIZE, SIZE), bool)
    for triangle in corners:
        edges = np.roll(triangle, -1, 0) - triangle
        offsets = pixels[:, :, None] - triangle
        sides = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0]
        mask |= (sides >= 0).all(-1) | (sides <= 0).all(-1)
    return mask


@pytest.fixture
def shape() -> trimesh.Trimesh:
    """A shape that no mirroring, turning or shifting leaves alone: three boxes of different sizes."""
    boxes = [trimesh.creation.box((1.2, 0.3, 0.3)), trimesh.creation.box((0.25, 0.7, 0.2))]
    boxes.append(trimesh.creation.box((0.2, 0.2, 0.9)))
    for box, place in zip(boxes, ([0.1, 0, 0], [-0.4, 0.3, 0], [0.6, 0, 0.4]), strict=True):
        box.apply_translation(place)
    return trimesh.util.concatenate(boxes)


@pytest.mark.parametrize("data_format", ["blender", "opencv"])
def test_mesh_seen_through_the_loader_covers_masks_drawn_by_projection(tmp_path, shape, data_format):
    generator = np.random.default_rng(0)
    centre = (SIZE / 2, SIZE / 2) if data_format == "blender" else (35.3, 28.9)
    document = {"camera_angle_x": 2 * math.atan(SIZE / 2 / FOCAL), "frames": []}
    document["cam_mat"] = [[FOCAL, 0, centre[0]], [0, FOCAL, centre[1]], [0, 0, 1]]
    for i in range(6):
        direction = generator.normal(size=3)
        pose = look_at(3 * direction / np.linalg.norm(direction), generator.normal(size=3))
        mask = rasterise(shape, pose, centre)
        Image.fromarray(np.zeros((SIZE, SIZE, 3), np.uint8)).save(tmp_path / f"{i}.png")
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(tmp_path / f"mask_{i}.png")
        pose = pose if data_format == "blender" else pose @ np.diag([1.0, -1, -1, 1])
        document["frames"].append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms_train.json").write_text(json.dumps(document))
    loader = BlenderData if data_format == "blender" else OpenCVData
    views = loader(str(tmp_path)).load("train")
    assert (intersection_over_union(silhouettes(views, shape), torch.stack(list(views.masks)) > 0.5) > 0.98).all()


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_embedded_mesh_covers_the_embedded_masks(split):
    views = BlenderData("embedded:torus").load(split)
    mesh = trimesh.load_mesh(resolve_path("embedded:torus/mesh.ply"))
    assert (intersection_over_union(silhouettes(views, mesh), torch.stack(list(views.masks)) > 0.5) > 0.98).all()
