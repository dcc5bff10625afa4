"""Binary glTF 2.0 files (.glb) of meshes."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_FLOAT, _UNSIGNED_INT, _TRIANGLES = 5126, 5125, 4
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_TYPES = {1: "SCALAR", 3: "VEC3"}


@dataclass(frozen=True)
class GltfMesh:
    """A mesh of one material."""

    name: str
    vertices: Float[np.ndarray, "V 3"]  # world units, z up; the file turns them to its y up
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]  # unit
    material: Mapping[str, Any]  # as glTF has it
    colours: Float[np.ndarray, "V 3"] | None = None  # linear


def encode_glb(meshes: Sequence[GltfMesh]) -> bytes:
    """The file of meshes, each a node of its own (Khronos, glTF 2.0, chapters 3 and 4)."""
    chunks: list[bytes] = []
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def add(values: np.ndarray, target: int) -> int:
        content = np.ascontiguousarray(values).tobytes()
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(content), "target": target})
        chunks.append(content)
        kind = _FLOAT if values.dtype == np.float32 else _UNSIGNED_INT
        accessor: dict[str, Any] = {"bufferView": len(views) - 1, "componentType": kind, "count": len(values)}
        accessor["type"] = _TYPES[1 if values.ndim == 1 else values.shape[1]]
        accessors.append(accessor)
        return len(accessors) - 1

    described = []
    for number, mesh in enumerate(meshes):
        places = np.asarray(mesh.vertices, np.float32)
        attributes = {"POSITION": add(places, _VERTICES)}
        accessors[-1] |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
        attributes["NORMAL"] = add(np.asarray(mesh.normals, np.float32), _VERTICES)
        if mesh.colours is not None:
            attributes["COLOR_0"] = add(np.asarray(mesh.colours, np.float32), _VERTICES)
        indices = add(np.asarray(mesh.faces, np.uint32).reshape(-1), _INDICES)
        primitive = {"attributes": attributes, "indices": indices, "material": number, "mode": _TRIANGLES}
        described.append({"name": mesh.name, "primitives": [primitive]})
    # A quarter turn about x, from z up to y up.
    turn = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
    numbers = range(len(meshes))
    document = {
        "asset": {"version": "2.0", "generator": "nerfro"},
        "scene": 0,
        "scenes": [{"nodes": [len(meshes)]}],
        "nodes": [
            *({"name": mesh.name, "mesh": number} for number, mesh in enumerate(meshes)),
            {"name": "z up", "rotation": turn, "children": list(numbers)},
        ],
        "meshes": described,
        "materials": [dict(mesh.material) for mesh in meshes],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(map(len, chunks))}],
        "extensionsUsed": sorted({name for mesh in meshes for name in mesh.material.get("extensions", {})}),
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(chunks)  # of whole four bytes
    total = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON"), text,
            struct.pack("<I4s", len(binary), b"BIN\0"), binary,
        ]
    )  # fmt: skip
