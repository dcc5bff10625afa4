"""Materials, nodes, compression and orientation of glTF files."""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.files.reading import MAX_JSON_BYTES, read_json, reading

# The y axis is up in glTF (specification 2.0, section 3.4), and the z axis in nerfro: (x, y, z) becomes (x, z, -y).
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUANTIZATION = "KHR_mesh_quantization"
_DRACO = "KHR_draco_mesh_compression"
_COMPRESSIONS = {
    _DRACO: "Draco compression",
    "EXT_meshopt_compression": "meshopt compression",
    "KHR_meshopt_compression": "meshopt compression",
    QUANTIZATION: "normalized positions",
}
# Extensions that do not change the shape.
_APPEARANCE = re.compile("material|texture|light|animation|xmp|audio")
_MODES = range(6)  # points, lines and triangles as trimesh reads them, in order of the file


@dataclass(frozen=True)
class GltfGlass:
    """Optical properties of a material with `KHR_materials_transmission`.

    Attributes:
        ior: refractive index, of the d line.
        absorption: coefficients of red, green and blue, per unit of the file.
        abbe: Abbe number; None without dispersion.
    """

    ior: float
    absorption: tuple[float, float, float]
    abbe: float | None


@dataclass(frozen=True)
class Primitive:
    """A set of triangles of a node.

    Attributes:
        node: name of the node.
        geometry: name of the geometry in the scene that trimesh reads.
        to_world: node to world, y axis up.
        material: material of the file; empty for the default material.
    """

    node: str
    geometry: str
    to_world: Float[np.ndarray, "4 4"]
    material: Mapping[str, Any]

    @property
    def glass(self) -> GltfGlass | None:
        """Optical properties of a refractive material; None for other materials."""
        return glass_of(self.material)


def glass_of(material: Mapping[str, Any]) -> GltfGlass | None:
    """Return the optical properties of a refractive material; None for other materials."""
    extensions = material.get("extensions", {})
    if not extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0) > 0:
        return None
    volume = extensions.get("KHR_materials_volume", {})
    colour = np.array(volume.get("attenuationColor", [1.0, 1.0, 1.0]), np.float64)
    # Beer-Lambert: light of the attenuation colour is left after the attenuation distance.
    red, green, blue = -np.log(colour.clip(1e-12, 1)) / volume.get("attenuationDistance", np.inf) + 0.0
    dispersion = extensions.get("KHR_materials_dispersion", {}).get("dispersion", 0)
    ior = float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5))
    return GltfGlass(ior, (float(red), float(green), float(blue)), 20 / dispersion if dispersion > 0 else None)


def is_gltf(path: Path) -> bool:
    """Return whether a file is in glTF format, by its suffix as trimesh decides."""
    return path.suffix.lower() in (".glb", ".gltf")


def require_readable(path: Path) -> None:
    """Raise an error if the shape of a glTF file cannot be read, and print once that its y axis is up.

    Raises:
        NerfroError: the geometry is compressed, or has a property that changes its shape and is not read.
    """
    document = read_document(path)
    if not isinstance(document, dict):
        return  # trimesh describes the damage
    used = [name for key in ("extensionsRequired", "extensionsUsed") for name in document.get(key) or ()]
    decoded = {_DRACO} if importlib.util.find_spec("DracoPy") is not None else set()
    if QUANTIZATION in used and not _has_normalized_positions(document):
        decoded.add(QUANTIZATION)
    for name, compression in _COMPRESSIONS.items():
        if name in used and name not in decoded:
            decoder = ", or pip install 'nerfro[gltf]', which decodes it" if name == _DRACO else ""
            raise NerfroError(
                f"mesh {path} has {compression} ({name}), which nerfro does not read; export it without "
                f"compression (in Blender, without the option Compression), or as ply{decoder}"
            )
    required = set(document.get("extensionsRequired") or ()) - decoded
    unknown = [name for name in sorted(required) if _APPEARANCE.search(name) is None]
    reason = f"requires {unknown[0]}" if unknown else _unread_shape(document, used)
    if reason is not None:
        raise NerfroError(
            f"mesh {path} {reason}, which nerfro does not read; apply it in the program that wrote the file, or "
            "export as ply"
        )
    _announce(path)


def files_beside(path: Path) -> Any:
    """Return the reader of files that a glTF file names; their names may be percent-encoded."""
    from trimesh.resolvers import FilePathResolver

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            exists = os.path.isfile(path.parent / name)
            return super().get(name if exists else unquote(name))  # type: ignore[no-any-return]

    return Resolver(str(path))


def _unread_shape(document: Mapping[str, Any], used: list[str]) -> str | None:
    """Name a property of a glTF file that changes its shape and that trimesh ignores; None if there is none."""
    meshes, nodes = document.get("meshes") or [], document.get("nodes") or []
    positions, indices = _accessors(document)
    properties = {
        "has sparse accessors": any("sparse" in accessor for accessor in (*positions, *indices)),
        "has shape keys (morph targets)": any(any(mesh.get("weights", [])) for mesh in (*meshes, *nodes)),
        "is posed by a skeleton (skin)": any("skin" in node for node in nodes),
        "has instances (EXT_mesh_gpu_instancing)": "EXT_mesh_gpu_instancing" in used,
    }
    return next((name for name, is_used in properties.items() if is_used), None)


def _has_normalized_positions(document: Mapping[str, Any]) -> bool:
    """Return whether positions are fractions of the largest integer, which trimesh does not divide by it."""
    return any(accessor.get("normalized", False) for accessor in _accessors(document)[0])


def _accessors(document: Mapping[str, Any]) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Return the descriptions of the positions and of the indices of all primitives."""
    primitives = [primitive for mesh in document.get("meshes") or [] for primitive in mesh.get("primitives", [])]
    accessors = document.get("accessors") or []
    positions = {primitive.get("attributes", {}).get("POSITION") for primitive in primitives}
    indices = {primitive.get("indices") for primitive in primitives}

    def described(numbers: set[int | None]) -> list[Mapping[str, Any]]:
        return [accessors[i] for i in numbers if i is not None and i < len(accessors)]

    return described(positions), described(indices)


@cache
def _announce(path: Path) -> None:
    print(f"nerfro: the y axis is up in the glTF file {path}; (x, y, z) becomes (x, -z, y), with z up")


def read_document(path: Path) -> Any:
    """Return the JSON document of a glTF file; None if there is none."""
    if path.suffix.lower() == ".gltf":
        return read_json(path, "export it again")
    with path.open("rb") as file:
        header = file.read(20)
        size = int.from_bytes(header[12:16], "little")
        if header[:4] != b"glTF" or header[16:] != b"JSON" or size > MAX_JSON_BYTES:
            return None
        return json.loads(file.read(size))


def world_nodes(document: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield all nodes of the scene with their matrices to the world, y axis up."""
    nodes = document.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    scenes = document.get("scenes", [])
    roots = [number for number in range(len(nodes)) if number not in children]
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    waiting = [(number, np.eye(4)) for number in reversed(roots)]
    while waiting:
        number, parent = waiting.pop()
        to_world = parent @ _matrix(nodes[number])
        yield nodes[number], to_world
        waiting += [(child, to_world) for child in reversed(nodes[number].get("children", []))]


def primitives_of(document: Mapping[str, Any], geometries: list[str]) -> list[Primitive]:
    """Return the triangles of all nodes with their materials.

    Args:
        document: JSON document of the file.
        geometries: names of the geometries that trimesh has read from the file, in order.

    Raises:
        NerfroError: the file has other geometries.
    """
    owners = [(mesh, p) for mesh, content in enumerate(document.get("meshes", [])) for p in content["primitives"]]
    owners = [(mesh, primitive) for mesh, primitive in owners if primitive.get("mode", 4) in _MODES]
    if len(owners) != len(geometries):
        raise NerfroError(f"the glTF file has {len(owners)} sets of triangles, but {len(geometries)} are readable")
    materials, primitives = document.get("materials", []), []
    for node, to_world in world_nodes(document):
        for (mesh, primitive), geometry in zip(owners, geometries, strict=True):
            if node.get("mesh") == mesh:
                number = primitive.get("material")
                material = {} if number is None else materials[number]
                primitives.append(Primitive(node.get("name", geometry), geometry, to_world, material))
    return primitives


def _matrix(node: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", [1.0, 1.0, 1.0]))
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def glass_of_file(path: Path) -> GltfGlass | None:
    """Return the optical properties of the bodies in a glTF file; None for a file without refractive materials.

    Raises:
        NerfroError: the file is damaged, or the bodies have different materials.
    """
    if not is_gltf(path):
        return None
    with reading(path, "mesh ", advice="export it again"):
        materials = read_document(path).get("materials", [])
        used = {glass_of(material) for material in materials} - {None}
    glass = next(iter(used), None)
    if len(used) > 1:
        raise NerfroError(
            f"mesh {path} has {len(used)} refractive materials; give the index (medium.ior), or write the bodies one "
            f"by one with nerfro.synthesize scene={path}, whose output has a scene.json"
        )
    if glass is not None and not (0 < glass.ior < np.inf and np.isfinite(glass.absorption).all()):
        raise NerfroError(
            f"mesh {path} has a material with the index {glass.ior:g} and the absorption {list(glass.absorption)}; "
            "give the index and the absorption of the body (bodies.NAME.ior, bodies.NAME.absorption)"
        )
    return glass
