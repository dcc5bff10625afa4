"""Glass and what is inside it as meshes for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.gltf import GltfMesh, encode_glb
from nerfro.files.images import to_8bit
from nerfro.files.ply import write_ply
from nerfro.geometry.mesh import TriangleMesh
from nerfro.light import to_srgb
from nerfro.media.solid import Solid
from nerfro.viewing.changes import absorption_of
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import ColouredMesh, bake, solid_surface

# Opacity of glass in a .ply, which knows no glass.
_GLASS_RGBA = (255, 255, 255, 60)


def write_mesh(scene: TrainedScene, out: Path, resolution: int, half_depth: float) -> str:
    """Write the surfaces of glass, and of what is solid inside: .glb with glass as a material, or .ply with colours."""
    glass = scene.surface if isinstance(scene.renderer.scene.medium, Solid) else []
    solid = find_solid(scene, resolution, half_depth)
    if not glass and solid is None:
        raise NerfroError("there is nothing to write: no glass, and nothing inside is solid; raise half_depth")
    if out.suffix.lower() == ".glb":
        write_atomically(out, encode_glb(_gltf_meshes(scene, glass, solid)))
    else:
        _write_ply(out, glass, solid)
    inside = "nothing solid inside" if solid is None else f"{len(solid.mesh.faces)} triangles inside"
    return f"{sum(len(mesh.faces) for mesh in glass)} triangles of glass, {inside}"


def find_solid(scene: TrainedScene, resolution: int, half_depth: float) -> ColouredMesh | None:
    """What is solid inside; None where nothing is."""
    try:
        return solid_surface(scene, bake(scene, resolution), half_depth)
    except NerfroError:
        return None


def with_normals(
    mesh: TriangleMesh,
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "F 3"], Float[np.ndarray, "W 3"]]:
    """Vertices, faces and normals of vertices: where the triangles' normals differ, vertices are there twice."""
    assert mesh.normals is not None
    corners = np.concatenate([mesh.triangles, mesh.normals], -1).reshape(-1, 6).astype(np.float32)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    return unique[:, :3], index.reshape(-1, 3), unique[:, 3:]


def _gltf_meshes(scene: TrainedScene, glass: list[TriangleMesh], solid: ColouredMesh | None) -> list[GltfMesh]:
    meshes = []
    for number, (mesh, ior, absorption) in enumerate(
        zip(glass, scene.ior, absorption_of(scene.renderer.scene), strict=True)
    ):
        thickness = float((mesh.bounds[1] - mesh.bounds[0]).min())
        material = _glass(f"glass {number}", float(ior), absorption.numpy(), thickness)
        vertices, faces, normals = with_normals(mesh)
        meshes.append(GltfMesh(f"glass_{number}", vertices, faces, normals, material))
    if solid is not None:
        # The colours are light that is seen, not albedo: no lamp of the program may shade them again.
        material = {"name": "inside", "extensions": {"KHR_materials_unlit": {}}}
        radiance = solid.radiance.clamp(0, 1).numpy()
        meshes.append(
            GltfMesh("inside", solid.mesh.vertices, solid.mesh.faces, solid.normals.numpy(), material, radiance)
        )
    return meshes


def _glass(name: str, ior: float, absorption: Float[np.ndarray, "3"], thickness: float) -> dict[str, Any]:
    """Khronos' KHR_materials_transmission, _ior and _volume; light that is absorbed is told at a distance of one."""
    volume: dict[str, Any] = {"thicknessFactor": thickness}
    if absorption.any():
        volume |= {"attenuationDistance": 1.0, "attenuationColor": np.exp(-absorption).tolist()}
    return {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.0},
        "extensions": {
            "KHR_materials_transmission": {"transmissionFactor": 1.0},
            "KHR_materials_ior": {"ior": ior},
            "KHR_materials_volume": volume,
        },
    }


def _write_ply(out: Path, glass: list[TriangleMesh], solid: ColouredMesh | None) -> None:
    parts = [with_normals(mesh) for mesh in glass]
    rgba = [np.tile(np.array(_GLASS_RGBA, np.uint8), (len(vertices), 1)) for vertices, _, _ in parts]
    if solid is not None:
        parts.append((solid.mesh.vertices, solid.mesh.faces, solid.normals.numpy()))
        colours = to_8bit(to_srgb(solid.radiance)).numpy()
        rgba.append(np.pad(colours, ((0, 0), (0, 1)), constant_values=255))
    offsets = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    faces = np.concatenate([faces + offset for (_, faces, _), offset in zip(parts, offsets, strict=False)])
    columns = dict(zip(("nx", "ny", "nz"), np.concatenate([normals for _, _, normals in parts]).T, strict=True))
    columns |= zip(("red", "green", "blue", "alpha"), np.concatenate(rgba).T, strict=True)
    write_ply(out, np.concatenate([vertices for vertices, _, _ in parts]), faces, columns)
