"""Binary .ply files of points and triangles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nerfro.files.atomic import atomic_file

_TYPES = {"f": ("float", "<f4"), "u": ("uchar", "u1")}


def write_ply(
    path: Path,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"] | None = None,
    properties: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write points, or triangles, with further values of each vertex.

    Args:
        path: of the file.
        vertices: world units, stored in single precision.
        faces: vertex indices of each triangle.
        properties: columns [V] by their names in the file: floating point, or 8 bits.
    """
    columns = dict(zip("xyz", np.asarray(vertices, np.float32).T, strict=True)) | dict(properties or {})
    names = {name: _TYPES[column.dtype.kind] for name, column in columns.items()}
    table = np.empty(len(vertices), [(name, kind) for name, (_, kind) in names.items()])
    for name, column in columns.items():
        table[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {word} {name}" for name, (word, _) in names.items()]
    triangles = np.empty(0 if faces is None else len(faces), [("count", "u1"), ("index", "<i4", 3)])
    if faces is not None:
        triangles["count"], triangles["index"] = 3, faces
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_file(path) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        file.write(table.tobytes() + triangles.tobytes())
