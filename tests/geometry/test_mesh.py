"""Reading meshes, and the messages about bad ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from nerfro.errors import NerfroError
from nerfro.geometry.mesh import load_mesh


@pytest.mark.parametrize("extension", ["ply", "obj", "stl", "glb"])
def test_any_format_gives_the_same_closed_mesh(tmp_path: Path, extension: str) -> None:
    file = tmp_path / f"ball.{extension}"
    trimesh.creation.icosphere(2, 0.7).export(file)
    mesh = load_mesh(file)
    assert mesh.faces.shape == (320, 3)
    assert mesh.vertices.shape == (162, 3)
    assert mesh.is_closed
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.7, rtol=1e-5)


def test_open_meshes_are_refused_unless_accepted(tmp_path: Path) -> None:
    shape = trimesh.creation.icosphere(2)
    shape.update_faces(np.arange(len(shape.faces)) > 3)
    shape.export(tmp_path / "open.ply")
    with pytest.raises(NerfroError, match=r"not watertight.*medium\.accept_open_mesh=true"):
        load_mesh(tmp_path / "open.ply")
    assert not load_mesh(tmp_path / "open.ply", accept_open_mesh=True).is_closed


def test_missing_garbled_and_empty_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(NerfroError, match=r"none\.ply does not exist"):
        load_mesh(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat nonsense")
    with pytest.raises(NerfroError, match=r"bad\.ply"):
        load_mesh(tmp_path / "bad.ply")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(NerfroError, match=r"points\.obj"):
        load_mesh(tmp_path / "points.obj")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(NerfroError, match=r"nan\.obj"):
        load_mesh(tmp_path / "nan.obj")
