"""Reading meshes, and the messages about bad ones."""

import json
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_glb

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh, load_mesh, load_points, subdivided
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


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_gltf_files_are_turned_from_y_up_to_z_up(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = trimesh.creation.icosphere(2).apply_transform(np.diag([1, 0.6, 0.4, 1])).apply_translation([0.1, 0.2, 0.3])
    normals = np.array(shape.vertex_normals)
    shape.export(tmp_path / "z_up.ply", vertex_normal=True)
    vertices, faces = shape.vertices[:, [0, 2, 1]] * [1, 1, -1], shape.faces
    y_up = trimesh.Trimesh(vertices, faces, vertex_normals=normals[:, [0, 2, 1]] * [1, 1, -1], process=False)
    file = tmp_path / f"y_up.{suffix}"
    trimesh.Scene(y_up).export(file, include_normals=True)
    expected = load_mesh(tmp_path / "z_up.ply")
    capsys.readouterr()
    turned = load_mesh(file)
    np.testing.assert_allclose(turned.vertices, expected.vertices, atol=1e-6)
    np.testing.assert_array_equal(turned.faces, expected.faces)
    assert (turned.normals is None) == (expected.normals is None)
    np.testing.assert_array_equal(np.unique(load_points(file), axis=0), turned.vertices)
    out = capsys.readouterr().out
    assert out.count("(x, -z, y)") == 1
    assert file.name in out


@pytest.mark.parametrize(
    ("extension", "name"),
    [("KHR_draco_mesh_compression", "Draco compression"), ("EXT_meshopt_compression", "meshopt compression"),
     ("KHR_mesh_quantization", "normalized positions")],
)  # fmt: skip
def test_compressed_gltf_is_refused(extension: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)  # as if it were not installed

    def compressed(tree: dict[str, Any]) -> None:
        tree["extensionsUsed"] = tree["extensionsRequired"] = [extension]
        tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]["normalized"] = True

    scene = trimesh.Scene(trimesh.creation.box())
    (tmp_path / "a.glb").write_bytes(export_glb(scene, tree_postprocessor=compressed))
    refused(rf"a\.glb has {name} \({extension}\).*export it without compression", load_mesh, tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda tree: tree["accessors"][0].update(sparse={"count": 1}), "sparse accessors"),
        (lambda tree: tree["meshes"][0].update(weights=[0.0, 1.0]), "shape keys"),
        (lambda tree: tree["nodes"][0].update(weights=[0.5]), "shape keys"),
        (lambda tree: tree["nodes"][0].update(skin=0), "skeleton"),
        (lambda tree: tree.update(extensionsUsed=["EXT_mesh_gpu_instancing"]), "instances"),
        (lambda tree: tree.update(extensionsRequired=["ACME_curves"]), "requires ACME_curves"),
    ],
)
def test_gltf_whose_shape_has_more_than_its_positions_is_refused(
    change: Callable[[dict[str, Any]], None], name: str, tmp_path: Path
) -> None:
    """trimesh reads the positions alone, without a word."""
    scene = trimesh.Scene(trimesh.creation.box())
    (tmp_path / "a.glb").write_bytes(export_glb(scene, tree_postprocessor=change))
    refused(rf"a\.glb .*{name}.*apply it in the program", load_mesh, tmp_path / "a.glb")


def test_gltf_finds_files_whose_names_are_percent_encoded(tmp_path: Path) -> None:
    """Blender writes a space as %20, as the specification demands."""
    written = trimesh.Scene(trimesh.creation.box()).export(file_type="gltf")
    document = json.loads(written["model.gltf"])
    for number, buffer in enumerate(document["buffers"]):
        (tmp_path / f"glass ({number})ü.bin").write_bytes(written[buffer["uri"]])
        buffer["uri"] = f"glass%20({number})%C3%BC.bin"
    (tmp_path / "glass (1).gltf").write_text(json.dumps(document))
    assert load_mesh(tmp_path / "glass (1).gltf").is_closed


def test_meshes_compressed_by_draco_are_decoded(tmp_path: Path) -> None:
    draco = pytest.importorskip("DracoPy")
    ball = trimesh.creation.icosphere(2, 0.7)
    encoded = draco.encode(np.asarray(ball.vertices, np.float32), faces=np.asarray(ball.faces, np.uint32))
    extension = {"bufferView": 0, "attributes": {"POSITION": 0}}
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "extensions": {"KHR_draco_mesh_compression": extension}}
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "extensionsUsed": ["KHR_draco_mesh_compression"], "extensionsRequired": ["KHR_draco_mesh_compression"],
        "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": len(encoded)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(encoded)}],
        "accessors": [
            {"componentType": 5126, "type": "VEC3", "count": len(ball.vertices),
             "min": ball.bounds[0].tolist(), "max": ball.bounds[1].tolist()},
            {"componentType": 5125, "type": "SCALAR", "count": ball.faces.size},
        ],
    }  # fmt: skip
    chunks = [(b"JSON", json.dumps(document).encode(), b" "), (b"BIN\0", encoded, b"\0")]
    padded = [(kind, content + filling * (-len(content) % 4)) for kind, content, filling in chunks]
    body = b"".join(struct.pack("<I", len(content)) + kind + content for kind, content in padded)
    (tmp_path / "ball.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)
    mesh = load_mesh(tmp_path / "ball.glb")
    assert (len(mesh.vertices), len(mesh.faces)) == (162, 320)
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(0.7, abs=1e-3)


def test_files_without_triangles_are_named(tmp_path: Path) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused(r"points\.obj", load_mesh, tmp_path / "points.obj")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_not_finite_are_refused_in_one_line(value: float, tmp_path: Path) -> None:
    """No operation before the check warns."""
    ball = trimesh.creation.icosphere(1)
    ball.vertices[3, 0] = value
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(tmp_path / "ball.ply")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused("vertices that are not finite", load_mesh, tmp_path / "ball.ply")


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


@pytest.mark.parametrize("shape", [trimesh.creation.box((1.2, 0.4, 0.1)), trimesh.creation.cylinder(0.3, 2.0)])
def test_long_edges_are_bisected_without_gaps(shape: trimesh.Trimesh) -> None:
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    fine = subdivided(mesh, 0.11)
    result = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    assert result.edges_unique_length.max() <= 0.11
    assert result.is_watertight
    assert (result.volume, result.area) == pytest.approx((shape.volume, shape.area))
    assert subdivided(fine, 0.11) is fine
