"""Export of glass and dense content as meshes in glTF format, with glass materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb

from nerfro.core.errors import NerfroError
from nerfro.exports.meshes import glass_meshes, inside_mesh, one_mesh
from nerfro.files.atomic import write_atomically
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.media.material import Dispersion
from nerfro.viewing.changes import absorption_of
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene


def write_mesh(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the surfaces of the glass and of the dense content, as .glb with materials, or as one mesh (.ply, .obj)."""
    suffix = out.suffix.lower()
    glass, inside = glass_meshes(scene), inside_mesh(scene, options.resolution, options.half_depth)
    if not glass and inside is None:
        raise NerfroError("the scene has neither glass nor dense content to write; raise half_depth")
    write_atomically(out, _encode_glb(scene, glass, inside) if suffix == ".glb" else one_mesh(glass, inside, suffix))
    content = "nothing solid inside" if inside is None else f"{len(inside.faces)} triangles inside"
    return f"{sum(len(mesh.faces) for mesh in glass)} triangles of glass, {content}"


_VERTICES, _INDICES = 34962, 34963  # ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER (glTF 2.0, section 5.11)


def _encode_glb(scene: TrainedScene, glass: list[trimesh.Trimesh], inside: trimesh.Trimesh | None) -> bytes:
    meshes, materials = {}, {}
    bodies = scene.renderer.scene.medium.bodies
    bodies_materials = [] if bodies is None else bodies.materials
    for number, (mesh, absorption) in enumerate(zip(glass, absorption_of(scene.renderer.scene), strict=True)):
        meshes[f"glass_{number}"] = mesh
        dispersion = bodies_materials[number].dispersion
        materials[f"glass_{number}"] = _glass_material(mesh, float(scene.ior[number]), absorption.numpy(), dispersion)
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

    document, turn = trimesh.Scene(), np.eye(4)
    turn[:3, :3] = Z_UP_TO_Y_UP
    for name, mesh in meshes.items():
        document.add_geometry(mesh, geom_name=name, node_name=name, transform=turn)
    return export_glb(document, include_normals=True, tree_postprocessor=add_materials)


def _glass_material(
    mesh: trimesh.Trimesh, ior: float, absorption: np.ndarray, dispersion: Dispersion | None
) -> dict[str, Any]:
    """Describe glass by the extensions KHR_materials_transmission, _ior, _volume and _dispersion (Khronos)."""
    volume: dict[str, Any] = {"thicknessFactor": float(mesh.extents.min())}
    if absorption.any():
        # At a distance of 1 / max(absorption), no channel underflows, whatever the world unit.
        distance = 1 / float(absorption.max())
        colour = np.exp(-absorption.astype(np.float64) * distance).tolist()
        volume |= {"attenuationDistance": distance, "attenuationColor": colour}
    extensions: dict[str, Any] = {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_ior": {"ior": ior},
        "KHR_materials_volume": volume,
    }
    if dispersion is not None:
        extensions["KHR_materials_dispersion"] = {"dispersion": 20 / dispersion.abbe}
    return {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.0}, "extensions": extensions}


EXPORTS["mesh"] = Export((".glb", ".ply", ".obj"), write_mesh, unused=("sky",))
