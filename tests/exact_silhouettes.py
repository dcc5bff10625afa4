"""Masks of a body from cameras around it, and visual hulls of the masks."""

import numpy as np
import torch
import trimesh
from matplotlib.path import Path as Polygon
from scipy.spatial import ConvexHull

from nerfro.core.cameras import Cameras
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.visual_hull import Silhouettes, carve_mesh, find_box
from tests.cameras_at import cameras_at, poses_towards_origin


def cameras_around(count: int, size: int, distance: float = 4.0, focal: float = 1.4, spread: float = 1.0) -> Cameras:
    """Cameras on a spiral over a sphere (the part of it around +z that `spread` says) that look at the origin."""
    z = 1 - spread * (2 * np.arange(count) + 1) / count
    turn = 2.4 * np.arange(count)
    back = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    return cameras_at(
        poses_towards_origin(back, distance, (0.3, 0.9, 0.1)), size, size, focal * size, near=1.0, far=9.0
    )


def photographed(mesh: trimesh.Trimesh, cameras: Cameras) -> Silhouettes:
    """Binary masks: pixels whose central ray meets the mesh."""
    body = TriangleMesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
    return Silhouettes.of(cameras, mesh_silhouettes(body, cameras, 1).float())


def photographed_softly(mesh: trimesh.Trimesh, cameras: Cameras, rays: int = 6) -> Silhouettes:
    """Masks of the share of each pixel that is covered, by so many rays a side."""
    fine = photographed(mesh, cameras.resized(rays * cameras.width, rays * cameras.height)).masks
    return Silhouettes.of(cameras, torch.nn.functional.avg_pool2d(fine[None], rays)[0])


def hull(silhouettes: Silhouettes, resolution: int, wrong_masks: int = 0) -> TriangleMesh:
    carved = carve_mesh(silhouettes, find_box(silhouettes, wrong_masks), resolution, wrong_masks)
    assert carved is not None
    return carved


def outline_of(points: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pixels whose centres lie in the convex hull of points of the picture."""
    centres = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    outline = Polygon(points[ConvexHull(points).vertices])
    return outline.contains_points(centres.reshape(-1, 2)).reshape(height, width)


def overlaps_of_convex_body(views: Views, vertices: np.ndarray) -> list[float]:
    """Intersection over union of each mask with the hull of the vertices that its camera sees."""
    assert views.masks is not None
    pixels, depth = views.cameras.project(torch.from_numpy(vertices).float())
    assert (depth > 0).all()
    overlaps = []
    for place, mask in zip(pixels.numpy(), views.masks, strict=True):
        seen = mask.numpy() > 0.5
        expected = outline_of(place, *seen.shape)
        overlaps.append((seen & expected).sum() / (seen | expected).sum())
    return overlaps


def volume(mesh: TriangleMesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume)


def odd_shape() -> trimesh.Trimesh:
    """A body without symmetry: three boxes of different sizes."""
    boxes = [trimesh.creation.box(size) for size in ((1.2, 0.45, 0.45), (0.4, 0.8, 0.35), (0.35, 0.35, 1.0))]
    for box, place in zip(boxes, ([0.1, 0, 0], [-0.4, 0.3, 0], [0.6, 0, 0.4]), strict=True):
        box.apply_translation(place)
    return trimesh.util.concatenate(boxes)
