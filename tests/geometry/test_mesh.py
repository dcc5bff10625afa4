"""Reading meshes, and the messages about bad ones."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import load_mesh
from tests.conftest import refused


@pytest.mark.parametrize("extension", ["ply", "obj", "stl", "glb"])
def test_any_format_gives_the_same_closed_mesh(tmp_path: Path, extension: str) -> None:
    file = tmp_path / f"ball.{extension}"
    trimesh.creation.icosphere(2, 0.7).export(file)
    mesh = load_mesh(file)
    assert mesh.faces.shape == (320, 3)
    assert mesh.vertices.shape == (162, 3)
    assert mesh.is_closed
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.7, rtol=1e-5)


def test_files_without_triangles_or_with_nan_are_named(tmp_path: Path) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused(r"points\.obj", load_mesh, tmp_path / "points.obj")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    refused(r"nan\.obj", load_mesh, tmp_path / "nan.obj")


@pytest.mark.parametrize("index", [-1, 8, 2**31 - 1])
def test_triangles_with_missing_vertices_are_refused(index: int, tmp_path: Path) -> None:
    box = trimesh.creation.box()
    lines = [f"{x} {y} {z}" for x, y, z in box.vertices] + [f"3 {a} {b} {c}" for a, b, c in box.faces]
    lines[-1] = f"3 0 1 {index}"
    header = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz")]
    header += ["element face 12", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "bad.ply").write_text("\n".join([*header, *lines]) + "\n")
    with pytest.raises(NerfroError, match=r"bad\.ply (has triangles with indices of missing vertices|cannot be read)"):
        load_mesh(tmp_path / "bad.ply", accept_open_mesh=True)
