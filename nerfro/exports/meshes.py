"""Meshes of the glass and of the dense content of a trained scene."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch.nn import functional

from nerfro.core.errors import optional, warn
from nerfro.core.light import to_srgb
from nerfro.files.images import to_8bit
from nerfro.geometry.bodies import bodies_of
from nerfro.geometry.interpolation import trilinear
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import corner_normals
from nerfro.viewing.surface import level_set, surface_of
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import POINTS_AT_ONCE, RESOLUTION, sample_field

if TYPE_CHECKING:
    import trimesh


def glass_meshes(scene: TrainedScene, triangles: int | None = None) -> list[trimesh.Trimesh]:
    """Triangulate the surface of each body, with vertex normals; returns an empty list without bodies.

    All surfaces together have at most half of `triangles`. Meshes whose triangles rays meet, and the mesh that a single
    body was made of, are written as they are, if they have so few triangles; other surfaces are simplified.
    """
    bodies = scene.renderer.scene.medium.bodies
    if bodies is None:
        return []
    is_simple = triangles is not None and len(bodies.meshes) == 1 and len(bodies.meshes[0].faces) <= triangles // 2
    surfaces = surface_of(bodies, triangles=True) if is_simple else scene.surface
    total = sum(len(mesh.faces) for mesh in surfaces)
    if triangles is not None and total > triangles // 2:
        limits = _divided([len(mesh.faces) for mesh in surfaces], triangles // 2)
        surfaces = [simplified(mesh, limit) for mesh, limit in zip(surfaces, limits, strict=True)]
        # Large flat triangles need the normal of their side, also where they meet a rounded edge.
        surfaces = [
            mesh if mesh.normals is not None else replace(mesh, normals=corner_normals(mesh)) for mesh in surfaces
        ]
    return [_with_vertex_normals(mesh) for mesh in surfaces]


def attenuation(absorption: Float[np.ndarray, "3"]) -> tuple[float, list[float]]:
    """Return a distance and the share of each channel that is left there, as formats describe absorption that is not 0.

    The distance is 1 / max(absorption), at which no channel underflows, whatever the world unit.
    """
    distance = 1 / float(absorption.max())
    return distance, np.exp(-absorption.astype(np.float64) * distance).tolist()


def _divided(sizes: Sequence[int], total: int) -> list[int]:
    """Divide a number of triangles among meshes: small meshes keep theirs, and the others have equal shares."""
    limits = list(sizes)
    in_order = sorted(range(len(sizes)), key=lambda i: sizes[i])
    for position, i in enumerate(in_order):
        limits[i] = min(sizes[i], total // (len(sizes) - position))
        total -= limits[i]
    return limits


def simplified(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """Reduce a mesh to a number of triangles, by edge collapses of the smallest quadric error; normals are dropped.

    A warning tells if more triangles are left. A mesh with so few triangles is returned as it is.

    Source:
        M. Garland and P. Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997; package
        fast-simplification.
    """
    if len(mesh.faces) <= triangles:
        return mesh
    if importlib.util.find_spec("fast_simplification") is None:
        warn("the meshes keep all their triangles; pip install 'nerfro[gltf]', which reduces their number")
        return mesh
    simplification = optional("fast_simplification", "gltf", "triangles= needs fast-simplification")
    vertices, faces, before = mesh.vertices, mesh.faces, len(mesh.faces) + 1
    while triangles < len(faces) < before:  # on flat surfaces, one call stops early
        before = len(faces)
        vertices, faces = simplification.simplify(vertices, faces.astype(np.int32), target_count=triangles)
    if len(faces) > triangles:
        warn(f"a mesh keeps {len(faces)} triangles, more than {triangles}, because no simpler mesh has its shape")
    return TriangleMesh(vertices, faces.astype(np.int64))


def _with_vertex_normals(mesh: TriangleMesh) -> trimesh.Trimesh:
    """Convert normals of triangle corners to normals of vertices; vertices on creases are duplicated."""
    import trimesh

    assert mesh.normals is not None
    corners = np.concatenate([mesh.triangles, mesh.normals], -1).reshape(-1, 6).astype(np.float32)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    return trimesh.Trimesh(unique[:, :3], index.reshape(-1, 3), vertex_normals=unique[:, 3:], process=False)


@torch.inference_mode()
def inside_mesh(
    scene: TrainedScene, resolution: int | None, half_depth: float | None, triangles: int | None = None
) -> trimesh.Trimesh | None:
    """Extract the surface of the dense content with marching cubes, with the radiance seen from outside.

    Small separate components are omitted.

    Args:
        scene: scene whose radiance field is sampled.
        resolution: grid vertices along the longest side, `RESOLUTION` by default.
        half_depth: length within which the density of the surface absorbs half the light, world units; by default a
            hundredth of the object's longest side.
        triangles: largest number of triangles; None keeps all.

    Returns:
        Mesh with vertex normals and the vertex attribute `radiance` (linear), or None if no content is dense enough.
    """
    volume = sample_field(scene, resolution or RESOLUTION)
    level = math.log(2) / (half_depth or 0.01 * float((scene.bounds[1] - scene.bounds[0]).max()))
    # The padding closes surfaces at the faces of the box. A logarithm of the density is closer to linear across a
    # surface than the density.
    values = functional.pad(volume.density, (1,) * 6).clamp(min=1e-3 * level).log()
    spacing = (volume.space.box[1] - volume.space.box[0]) / (torch.tensor(volume.density.shape) - 1)
    box = volume.space.box + torch.stack([-spacing, spacing])
    if not values.max() > math.log(level):
        return None
    mesh = largest_components(level_set(values, box, math.log(level)))
    if triangles is not None:
        mesh = simplified(mesh, triangles)
    vertices = torch.from_numpy(mesh.vertices).float()
    gradients = torch.stack(torch.gradient(values), -1) / spacing
    normals = -functional.normalize(trilinear(gradients, box, vertices), dim=-1)
    network = scene.renderer.scene
    radiance = [
        scene.field.at_points(positions.to(network.device), directions.to(network.device))[1].cpu()
        for positions, directions in zip(vertices.split(POINTS_AT_ONCE), (-normals).split(POINTS_AT_ONCE), strict=True)
    ]
    linear = network.colour_space.to_linear(torch.cat(radiance)).numpy()
    import trimesh

    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=normals.numpy(), vertex_attributes={"radiance": linear}, process=False
    )


def one_mesh(glass: Sequence[trimesh.Trimesh], inside: trimesh.Trimesh | None, suffix: str) -> bytes:
    """Encode all surfaces as one mesh in world coordinates, with normals, and sRGB colours of the content.

    Args:
        glass: surfaces of the bodies, which become white.
        inside: dense content, or None.
        suffix: ending of the file, `.ply` or `.obj`.
    """
    import trimesh
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.ply import export_ply

    parts = [*glass, *([] if inside is None else [inside])]
    colours = [np.full((len(mesh.vertices), 3), 255, np.uint8) for mesh in glass]
    if inside is not None:
        colours.append(colours_of(inside))
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in parts)])
    joined = trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in parts]),
        np.concatenate([mesh.faces + start for mesh, start in zip(parts, starts, strict=False)]),
        vertex_normals=np.concatenate([mesh.vertex_normals for mesh in parts]),
        vertex_colors=np.concatenate(colours),
        process=False,
    )
    if suffix == ".obj":
        return export_obj(joined, include_normals=True, include_texture=False).encode()
    return export_ply(joined, vertex_normal=True)


def colours_of(inside: trimesh.Trimesh) -> UInt8[np.ndarray, "V 3"]:
    """Return the sRGB colours of the vertices of `inside_mesh`."""
    return to_8bit(to_srgb(torch.from_numpy(inside.vertex_attributes["radiance"]))).numpy()


def largest_components(mesh: TriangleMesh) -> TriangleMesh:
    """Remove small separate components, which are artefacts that explain edges and reflections of the glass."""
    component = bodies_of(mesh)
    counts = np.bincount(component)
    # Smaller components are dropped.
    used, index = np.unique(mesh.faces[counts[component] >= 0.02 * counts.max()], return_inverse=True)
    return TriangleMesh(mesh.vertices[used], index.reshape(-1, 3))
