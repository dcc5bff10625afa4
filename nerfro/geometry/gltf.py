"""Orientation and compression of glTF files."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from nerfro.core.errors import NerfroError
from nerfro.files.reading import MAX_JSON_BYTES, read_json

# The y axis is up in glTF (specification 2.0, section 3.4), and the z axis in nerfro: (x, y, z) becomes (x, z, -y).
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_COMPRESSIONS = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
    "KHR_mesh_quantization": "quantized positions",
}


def is_gltf(path: Path) -> bool:
    """Return whether a file is in glTF format, by its suffix as trimesh decides."""
    return path.suffix.lower() in (".glb", ".gltf")


def require_readable(path: Path) -> None:
    """Raise an error if a glTF file is compressed, and print once that its y axis is up.

    Raises:
        NerfroError: the geometry is compressed.
    """
    document = _document(path)
    if not isinstance(document, dict):
        return  # trimesh describes the damage
    used = [name for key in ("extensionsRequired", "extensionsUsed") for name in document.get(key) or ()]
    for name, compression in _COMPRESSIONS.items():
        if name in used:
            raise NerfroError(
                f"mesh {path} is compressed by {compression} ({name}), which nerfro does not read; export it without "
                "compression (in Blender, without the option Compression), or as ply"
            )
    _announce(path)


@cache
def _announce(path: Path) -> None:
    print(f"nerfro: the y axis is up in the glTF file {path}; (x, y, z) becomes (x, -z, y), with z up")


def _document(path: Path) -> Any:
    """Return the JSON document of a glTF file; None if there is none."""
    if path.suffix.lower() == ".gltf":
        return read_json(path, "export it again")
    with path.open("rb") as file:
        header = file.read(20)
        size = int.from_bytes(header[12:16], "little")
        if header[:4] != b"glTF" or header[16:] != b"JSON" or size > MAX_JSON_BYTES:
            return None
        return json.loads(file.read(size))
