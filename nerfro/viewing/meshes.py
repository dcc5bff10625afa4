"""Export of glass and dense content as meshes in glTF format, with glass materials."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch.nn import functional
from trimesh.exchange.gltf import export_glb

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.geometry.interpolation import trilinear
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.solid import Solid
from nerfro.viewing.changes import absorption_of
from nerfro.viewing.surface import largest_components, level_set
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import POINTS_AT_ONCE, RESOLUTION, sample_field

_HALF_DEPTH = 0.01  # default of half_depth, relative to the longest side of the object
# The y axis is up in glTF, and the z axis in nerfro.
_Z_UP_TO_Y_UP = trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0])


def write_mesh(scene: TrainedScene, out: Path, resolution: int | None, half_depth: float | None) -> str:
    """Write the surfaces of the glass and of the dense content as .glb; see `inside_mesh` for the options."""
    glass, inside = glass_meshes(scene), inside_mesh(scene, resolution, half_depth)
    if not glass and inside is None:
        raise NerfroError("the scene has neither glass nor dense content to write; raise half_depth")
    write_atomically(out, _encode_glb(scene, glass, inside))
    content = "nothing solid inside" if inside is None else f"{len(inside.faces)} triangles inside"
    return f"{sum(len(mesh.faces) for mesh in glass)} triangles of glass, {content}"


def glass_meshes(scene: TrainedScene) -> list[trimesh.Trimesh]:
    """Triangulate the surface of each body, with vertex normals; returns an empty list without bodies."""
    if not isinstance(scene.renderer.scene.medium, Solid):
        return []
    return [_with_vertex_normals(mesh) for mesh in scene.surface]


def _with_vertex_normals(mesh: TriangleMesh) -> trimesh.Trimesh:
    """Convert normals of triangle corners to normals of vertices; vertices on creases are duplicated."""
    assert mesh.normals is not None
    corners = np.concatenate([mesh.triangles, mesh.normals], -1).reshape(-1, 6).astype(np.float32)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    return trimesh.Trimesh(unique[:, :3], index.reshape(-1, 3), vertex_normals=unique[:, 3:], process=False)


@torch.inference_mode()
def inside_mesh(scene: TrainedScene, resolution: int | None, half_depth: float | None) -> trimesh.Trimesh | None:
    """Extract the surface of the dense content with marching cubes, with the radiance seen from outside.

    Small separate components are omitted.

    Args:
        scene: scene whose radiance field is sampled.
        resolution: grid vertices along the longest side, `RESOLUTION` by default.
        half_depth: length within which the density of the surface absorbs half the light, world units; by default a
            hundredth of the object's longest side.

    Returns:
        Mesh with vertex normals and the vertex attribute `radiance` (linear), or None if no content is dense enough.
    """
    volume = sample_field(scene, resolution or RESOLUTION)
    level = math.log(2) / (half_depth or _HALF_DEPTH * float((scene.bounds[1] - scene.bounds[0]).max()))
    # The padding closes surfaces at the faces of the box. A logarithm of the density is closer to linear across a
    # surface than the density.
    values = functional.pad(volume.density, (1,) * 6).clamp(min=1e-3 * level).log()
    spacing = (volume.box[1] - volume.box[0]) / (torch.tensor(volume.density.shape) - 1)
    box = volume.box + torch.stack([-spacing, spacing])
    if not values.max() > math.log(level):
        return None
    mesh = largest_components(level_set(values, box, math.log(level)))
    vertices = torch.from_numpy(mesh.vertices).float()
    gradients = torch.stack(torch.gradient(values), -1) / spacing
    normals = -functional.normalize(trilinear(gradients, box, vertices), dim=-1)
    network = scene.renderer.scene
    radiance = [
        scene.field.at_points(positions.to(network.device), directions.to(network.device))[1].cpu()
        for positions, directions in zip(vertices.split(POINTS_AT_ONCE), (-normals).split(POINTS_AT_ONCE), strict=True)
    ]
    linear = network.colour_space.to_linear(torch.cat(radiance)).numpy()
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=normals.numpy(), vertex_attributes={"radiance": linear}, process=False
    )


_VERTICES, _INDICES = 34962, 34963  # ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER (glTF 2.0, section 5.11)


def _encode_glb(scene: TrainedScene, glass: list[trimesh.Trimesh], inside: trimesh.Trimesh | None) -> bytes:
    meshes, materials = {}, {}
    for number, (mesh, absorption) in enumerate(zip(glass, absorption_of(scene.renderer.scene), strict=True)):
        meshes[f"glass_{number}"] = mesh
        materials[f"glass_{number}"] = _glass_material(mesh, float(scene.ior[number]), absorption.numpy())
    if inside is not None:
        meshes["inside"] = inside
        inside.vertex_attributes["radiance"] = np.clip(inside.vertex_attributes["radiance"], 0, 1)
        # The colours are radiance and not albedo, so lights of the other program must not shade them again.
        materials["inside"] = {"extensions": {"KHR_materials_unlit": {}}}

    def add_materials(document: dict[str, Any]) -> None:
        """Add what trimesh does not write: extensions of materials, targets of buffers, and floating-point colours."""
        document["materials"] = [{"name": name, **material} for name, material in materials.items()]
        document["extensionsUsed"] = sorted(
            {name for material in materials.values() for name in material["extensions"]}
        )
        for mesh in document["meshes"]:
            (primitive,) = mesh["primitives"]
            primitive["material"] = list(materials).index(mesh["name"])
            if "_radiance" in primitive["attributes"]:
                primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_radiance")
            for accessor in primitive["attributes"].values():
                document["bufferViews"][document["accessors"][accessor]["bufferView"]]["target"] = _VERTICES
            document["bufferViews"][document["accessors"][primitive["indices"]]["bufferView"]]["target"] = _INDICES

    document = trimesh.Scene()
    for name, mesh in meshes.items():
        document.add_geometry(mesh, geom_name=name, node_name=name, transform=_Z_UP_TO_Y_UP)
    return export_glb(document, include_normals=True, tree_postprocessor=add_materials)


def _glass_material(mesh: trimesh.Trimesh, ior: float, absorption: np.ndarray) -> dict[str, Any]:
    """Describe glass by KHR_materials_transmission, KHR_materials_ior and KHR_materials_volume (Khronos)."""
    volume: dict[str, Any] = {"thicknessFactor": float(mesh.extents.min())}
    if absorption.any():
        volume |= {"attenuationDistance": 1.0, "attenuationColor": np.exp(-absorption).tolist()}
    return {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.0},
        "extensions": {
            "KHR_materials_transmission": {"transmissionFactor": 1.0},
            "KHR_materials_ior": {"ior": ior},
            "KHR_materials_volume": volume,
        },
    }
