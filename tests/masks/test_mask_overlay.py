"""A known mesh, seen through the loaders' cameras, covers the masks."""

import json
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from nerfro.data.formats.transforms import BlenderData, OpenCVData
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.agreement import overlap
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.exact_silhouettes import odd_shape
from tests.sheet_photographs import look_at

SIZE = 64
FOCAL = 80.0


def rasterise(mesh: trimesh.Trimesh, pose: np.ndarray, centre: tuple[float, float]) -> np.ndarray:
    """Mask [H, W] by projecting each triangle with K [R | t] (OpenCV) and filling it at pixel centres, in float64."""
    x, y, z = ((mesh.vertices - pose[:, 3]) @ pose[:, :3]).T
    corners = np.stack([centre[0] + FOCAL * x / z, centre[1] + FOCAL * y / z], -1)[mesh.faces]
    column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    pixels = np.stack([column, row], -1)
    mask = np.zeros((SIZE, SIZE), bool)
    for triangle in corners:
        edges = np.roll(triangle, -1, 0) - triangle
        offsets = pixels[:, :, None] - triangle
        sides = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0]
        mask |= (sides >= 0).all(-1) | (sides <= 0).all(-1)
    return mask


@pytest.mark.parametrize("data_format", ["blender", "opencv"])
def test_projected_mesh_covers_its_masks_after_loading(tmp_path, data_format):
    generator, shape = np.random.default_rng(0), odd_shape()
    centre = (SIZE / 2, SIZE / 2) if data_format == "blender" else (35.3, 28.9)
    document = {"camera_angle_x": 2 * math.atan(SIZE / 2 / FOCAL), "frames": []}
    document["cam_mat"] = [[FOCAL, 0, centre[0]], [0, FOCAL, centre[1]], [0, 0, 1]]
    for i in range(6):
        direction = generator.normal(size=3)
        pose = look_at(3 * direction / np.linalg.norm(direction), np.zeros(3), generator.uniform(0, 6))
        Image.fromarray(np.zeros((SIZE, SIZE, 3), np.uint8)).save(tmp_path / f"{i}.png")
        Image.fromarray(np.uint8(255 * rasterise(shape, pose, centre))).save(tmp_path / f"mask_{i}.png")
        pose = pose * [1, -1, -1, 1] if data_format == "blender" else pose
        document["frames"].append({"file_path": f"{i}.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    (tmp_path / "transforms_train.json").write_text(json.dumps(document))
    loader = BlenderData if data_format == "blender" else OpenCVData
    views = loader(str(tmp_path)).load("train")
    silhouettes = Silhouettes.of(views.cameras, torch.stack(list(views.masks)))
    assert overlap(TriangleMesh(shape.vertices, shape.faces), silhouettes, 128).min() > 0.98
