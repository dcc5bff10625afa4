"""Scenes of glTF files: materials, nodes, cavities, cameras and data sets."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from trimesh.exchange.gltf import export_glb

from nerfro.core.light import to_srgb
from nerfro.files.images import load_png
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.geometry.mesh import load_mesh
from nerfro.media.body_settings import make_bodies
from nerfro.registry.allowed import validate
from nerfro.rendering.scene_file import read_scene_file
from nerfro.synthetic.gltf_scene import GltfScene
from nerfro.synthetic.options import SynthesizeConfig
from nerfro.synthetic.synthesis import synthesize
from tests.conftest import refused

GLASS = {
    "name": "glass",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.2},
    "extensions": {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_ior": {"ior": 1.4},
        "KHR_materials_volume": {
            "thicknessFactor": 1.0, "attenuationDistance": 0.5, "attenuationColor": [0.5, 1.0, 0.25]
        },
        "KHR_materials_dispersion": {"dispersion": 0.4},
    },
}  # fmt: skip
RED = {"name": "red", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.1, 0.1, 1], "metallicFactor": 0.0},
       "emissiveFactor": [0.1, 0, 0]}  # fmt: skip
CAMERAS = [{"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0, "znear": 0.1}}]
EXTENT = np.array([0.5, 0.4, 0.3])


def set_materials(tree: dict[str, Any], opaque: Collection[str]) -> None:
    """Make the meshes of a glTF document of glass, and the opaque ones red."""
    tree["materials"] = [GLASS, RED]
    for mesh in tree["meshes"]:
        mesh["primitives"][0]["material"] = int(mesh["name"] in opaque)


def write_scene(path: Path, *, hollow: bool = False) -> Path:
    """Write an ellipsoid of glass around a red cube, in a turned and scaled node, with a camera on the x axis."""
    shape = trimesh.creation.icosphere(3).apply_transform(np.diag([*EXTENT, 1]))
    meshes = {"drop": shape, "cube": trimesh.creation.box([0.2, 0.2, 0.2])}
    if hollow:
        meshes["air"] = shape.copy().apply_scale(0.9)
        meshes["air"].invert()
    turn = np.eye(4)
    turn[:3, :3] = Z_UP_TO_Y_UP
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        scene.add_geometry(mesh, geom_name=name, node_name=name, transform=turn @ np.diag([2.0, 2.0, 2.0, 1.0]))

    def add(tree: dict[str, Any]) -> None:
        set_materials(tree, ["cube"])
        tree["cameras"] = CAMERAS
        tree["nodes"].append({"name": "eye", "camera": 0, "translation": [0, 0, 4.0]})
        tree["scenes"][0]["nodes"].append(len(tree["nodes"]) - 1)

    path.write_bytes(export_glb(scene, tree_postprocessor=add))
    return path


def test_vertex_colours_are_factors_of_the_colour_of_the_material(tmp_path: Path) -> None:
    cube = trimesh.creation.box([0.2, 0.2, 0.2])
    cube.visual.vertex_colors = np.tile(np.array([255, 51, 102, 255], np.uint8), (8, 1))
    scene = trimesh.Scene({"drop": trimesh.creation.icosphere(1), "cube": cube})

    content = export_glb(scene, tree_postprocessor=lambda tree: set_materials(tree, ["cube"]))
    (tmp_path / "colours.glb").write_bytes(content)
    (part,) = (part for part in GltfScene(tmp_path / "colours.glb").parts if part.ior is None)
    assert part.surface.colours is not None
    expected = to_srgb(np.array([0.8, 0.1, 0.1]) * [1.0, 0.2, 0.4])
    np.testing.assert_allclose(part.surface.colours, np.tile(expected, (36, 1)), rtol=1e-5)


def test_materials_of_nodes_become_bodies_and_contents(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drop, cube = GltfScene(write_scene(tmp_path / "drop.glb")).parts
    assert (drop.name, drop.ior) == ("drop", 1.4)
    np.testing.assert_allclose(drop.absorption, np.log([2.0, 1.0, 4.0]) / 0.5, rtol=1e-9)
    np.testing.assert_allclose(np.abs(drop.surface.vertices).max(0), 2 * EXTENT, atol=1e-5)
    assert cube.ior is None
    assert cube.outer_absorption == drop.absorption
    np.testing.assert_allclose(cube.albedo, [0.8, 0.1, 0.1])
    out = capsys.readouterr().out
    assert "material glass: roughness is not modelled" in out
    assert "material glass: dispersion is not modelled" in out
    assert "material red: emission is not modelled" in out


def test_body_that_faces_inwards_is_a_cavity(tmp_path: Path) -> None:
    drop, air, cube = GltfScene(write_scene(tmp_path / "drop.glb", hollow=True)).parts
    assert [part.name for part in (drop, air, cube)] == ["drop", "air", "cube"]
    assert (air.ior, air.outer_ior, not any(air.absorption)) == (1.0, 1.4, True)
    assert cube.outer_absorption == air.absorption


def test_mesh_of_a_gltf_file_has_the_index_of_its_material(tmp_path: Path) -> None:
    file = str(write_scene(tmp_path / "drop.glb"))
    (body,) = make_bodies(file, resolution=16, cache=False).materials
    assert (body.ior.item(), body.dispersion is not None) == (1.4, True)
    torch.testing.assert_close(body.absorption, torch.tensor([2.0, 1.0, 4.0]).log() / 0.5)
    assert make_bodies(file, 1.6, resolution=16, cache=False).iors.item() == 1.6
    named = make_bodies(bodies={"a": {"mesh": file, "absorption": [1.0]}}, resolution=16, cache=False)
    assert named.iors.item() == 1.4
    torch.testing.assert_close(named.absorption, torch.ones(1, 3))
    np.testing.assert_allclose(np.abs(load_mesh(Path(file)).vertices).max(0), 2 * EXTENT, atol=1e-5)


def test_files_without_a_closed_refractive_body_are_refused(tmp_path: Path) -> None:
    trimesh.Scene(trimesh.creation.box()).export(tmp_path / "box.glb")
    refused("has no closed body with KHR_materials_transmission", GltfScene, tmp_path / "box.glb")
    refused("does not exist; give a glTF file as scene=FILE.glb", GltfScene, tmp_path / "none.glb")


@pytest.mark.usefixtures("mitsuba")
def test_gltf_file_becomes_a_data_set(tmp_path: Path) -> None:
    views = {"train": 1, "val": 1, "test": 1}
    file = write_scene(tmp_path / "drop.glb")
    options = {"scene": str(file), "resolution": 32, "spp": 16, "test_spp": 16, "views": views, "sky_height": 16}
    data = synthesize(validate(SynthesizeConfig, options | {"out": str(tmp_path / "orbit")}))
    scene = read_scene_file(data.folder / "scene.json")
    assert scene.bodies["drop"].ior == 1.4
    mesh = load_mesh(Path(str(scene.bodies["drop"].mesh)))
    np.testing.assert_allclose(np.abs(mesh.vertices).max(0), 2 * EXTENT, atol=1e-5)
    assert f"scene={data.folder}/scene.json" in data.next_command()
    # The camera of the file looks along -z in the file, which is +y here, from a distance of 4.
    data = synthesize(validate(SynthesizeConfig, options | {"out": str(tmp_path / "own"), "cameras": "file"}))
    (frame,) = json.loads((data.folder / "transforms_train.json").read_text())["frames"]
    np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], [0, -4, 0], atol=1e-6)
    mask = load_png(data.folder / "masks/train/r_000.png")
    image = load_png(data.folder / "train/r_000.png")
    assert image.shape[:2] == (16, 32)
    # An outline of half height 0.6 at a distance of 4, from the tangents of the ellipse in the plane through the axis.
    height = 0.6 / np.sqrt(1 - (0.8 / 4) ** 2) / 4 * 16 / np.tan(0.25)
    assert (mask[..., 0] if mask.ndim == 3 else mask)[:, 16].sum().item() == pytest.approx(height, rel=0.02)
    red, green, blue = image[8, 16].tolist()[:3]  # the glass absorbs blue and half of the red light
    assert red > green > 2 * blue
