"""Every export is read back by another program's reader, and shows the scene that was written."""

import json
import math
import shutil
import subprocess
import zipfile
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import cv2
import numpy as np
import OpenImageIO
import pytest
import torch
import trimesh
from PIL import Image

from nerfro.core.light import to_linear, to_srgb
from nerfro.data.formats.colmap_model import lens_of, read_colmap
from nerfro.exports.meshes import _divided
from nerfro.files.lat_long import load_lat_long
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.space import Box
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.traced_file import make_rays
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.camera_paths import CaptureGeometry, read_cameras
from nerfro.viewing.exports import ExportConfig, export_of, find_export
from nerfro.viewing.trained_scene import TrainedScene, with_changed_scene
from tests.conftest import Runner, refused
from tests.viewing.conftest import INSIDE_CENTRE, INSIDE_RADIUS, IOR, RADIUS, Photographs, colour, sky_of


def document_of(file: Path) -> dict:
    content = file.read_bytes()
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


def objects_of(file: Path) -> dict[str, trimesh.Trimesh]:
    """The objects of a .glb in world coordinates, z axis up."""
    scene, turn = trimesh.load(file, process=False), np.eye(4)
    turn[:3, :3] = Z_UP_TO_Y_UP.T
    return {name: mesh.apply_transform(turn @ scene.graph.get(name)[0]) for name, mesh in scene.geometry.items()}


CELL = 2.12 * RADIUS / 47  # of the box with its margin of air


def write(scene: TrainedScene, what: str, out: Path, **options: object) -> str:
    asked = ExportConfig(**{"checkpoint": "-", "what": what, "out": str(out), "resolution": 48} | options)
    return find_export(what, out).write(scene, out, asked)


@pytest.mark.slow
def test_glb_contains_glass_as_dielectric_and_the_content_as_emission(scene: TrainedScene, tmp_path: Path) -> None:
    write(scene, "mesh", tmp_path / "ball.glb")
    glass, inside = (objects_of(tmp_path / "ball.glb")[name] for name in ("glass_0", "inside"))
    np.testing.assert_allclose(np.linalg.norm(glass.vertices, axis=1), RADIUS, atol=3e-3)
    np.testing.assert_allclose(np.linalg.norm(inside.vertices - INSIDE_CENTRE, axis=1), INSIDE_RADIUS, atol=CELL)
    for mesh, centre, radius in ((glass, (0, 0, 0), RADIUS), (inside, INSIDE_CENTRE, INSIDE_RADIUS)):
        assert mesh.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.1), "faces point outwards"
        cosine = (mesh.vertex_normals * (mesh.vertices - centre)).sum(-1) / np.linalg.norm(mesh.vertices - centre)
        assert (cosine > 0).all(), "and so do normals"
    expected = colour(torch.from_numpy(np.asarray(inside.vertices)))
    np.testing.assert_allclose(inside.visual.vertex_attributes["color"] / 65535, expected, atol=1e-4)
    # The file is turned on import as on export, and content is no part of the body.
    again = load_mesh(tmp_path / "ball.glb", accept_open_mesh=True).vertices
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), RADIUS, atol=3e-3)
    # The sky beside the file, and the cameras, which look at the origin.
    assert load_lat_long(tmp_path / "ball_sky.hdr").shape[1] == 1024
    nodes = [node for node in document_of(tmp_path / "ball.glb")["nodes"] if "camera" in node]
    poses = np.stack([np.array(node["matrix"]).reshape(4, 4).T for node in nodes])
    eyes = scene.cameras("train").camera_to_world[..., 3].numpy() @ Z_UP_TO_Y_UP.T
    np.testing.assert_allclose(poses[:, :3, 3], eyes, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, 2], eyes / np.linalg.norm(eyes, axis=1, keepdims=True), atol=1e-6)
    document = document_of(tmp_path / "ball.glb")
    materials = {material["name"]: material for material in document["materials"]}
    extensions = materials["glass_0"]["extensions"]
    assert extensions["KHR_materials_transmission"] == {"transmissionFactor": 1.0}
    assert extensions["KHR_materials_ior"]["ior"] == pytest.approx(IOR)
    # A thickness is in coordinates of the mesh.
    scale = np.linalg.norm(next(node for node in document["nodes"] if node["name"] == "glass_0")["matrix"][:3])
    thickness = scale * extensions["KHR_materials_volume"]["thicknessFactor"]
    assert thickness == pytest.approx(2 * RADIUS, rel=5e-3)
    assert "KHR_materials_unlit" in materials["inside"]["extensions"]
    for mesh in document["meshes"]:
        assert document["materials"][mesh["primitives"][0]["material"]]["name"] == mesh["name"]
    # The z axis is up in nerfro, and the y axis in the file.
    node = next(node for node in document["nodes"] if node["name"] == "inside")
    accessor = document["accessors"][document["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"]]
    middle = np.mean([accessor["min"], accessor["max"]], axis=0)
    lifted = np.array(node["matrix"]).reshape(4, 4).T @ [*middle, 1]
    np.testing.assert_allclose(lifted[:3], [INSIDE_CENTRE[0], INSIDE_CENTRE[2], -INSIDE_CENTRE[1]], atol=CELL)


def test_page_beside_the_glb_shows_it_from_the_training_cameras(scene: TrainedScene, tmp_path: Path) -> None:
    write(scene, "mesh", tmp_path / "ball.glb", resolution=16)
    page = (tmp_path / "ball_viewer.html").read_text()
    element = ElementTree.fromstring(
        page[page.index("<model-viewer") : page.index("</model-viewer>")].replace(" camera-controls", "")
        + "</model-viewer>"
    )
    for name in ("src", "skybox-image"):
        assert (tmp_path / element.attrib[name]).is_file()
    views = json.loads(page[page.index("cameras = ") + 10 : page.index(", viewer = ")])
    cameras = scene.cameras("train")
    assert len(views) == len(cameras)
    for pose, entry in zip(cameras.camera_to_world.numpy(), views, strict=True):
        orbit, view = entry["view"]["cameraOrbit"].split(), entry["view"]
        azimuth, polar, distance = float(orbit[0][:-3]), float(orbit[1][:-3]), float(orbit[2][:-1])
        azimuth, polar = math.radians(azimuth), math.radians(polar)
        target = np.array([float(number[:-1]) for number in view["cameraTarget"].split()])
        # Of the orbit of the element: https://modelviewer.dev/docs/#entrydocs-stagingandcameras-attributes-cameraOrbit
        eye = target + distance * np.array(
            [math.sin(polar) * math.sin(azimuth), math.cos(polar), math.sin(polar) * math.cos(azimuth)]
        )
        np.testing.assert_allclose(eye, Z_UP_TO_Y_UP @ pose[:, 3], atol=1e-3)
        np.testing.assert_allclose(target, 0, atol=1e-3)
        # The element shows no depths far below its largest radius.
        assert distance < float(element.attrib["max-camera-orbit"].split()[-1][:-1]) < 10 * distance
        assert float(view["fieldOfView"][:-3]) == pytest.approx(math.degrees(0.7), abs=1e-3)


@pytest.fixture
def two_bodies(scene: TrainedScene, tmp_path: Path) -> TrainedScene:
    """Bodies apart: a ball of water that disperses, and an absorbing ball."""
    bodies: dict[str, dict] = {"water": {"material": "water"}, "tinted": {"ior": 1.4, "absorption": [0.5, 0.1, 0.2]}}
    for name, x in (("water", -0.7), ("tinted", 0.7)):
        shape = trimesh.creation.icosphere(3, 0.4)
        shape.apply_translation([x, 0, 0])
        shape.export(tmp_path / f"{name}.ply")
        bodies[name]["mesh"] = str(tmp_path / f"{name}.ply")
    medium = make_bodies(bodies=bodies, resolution=32, cache=False)
    return replace(scene, renderer=with_changed_scene(scene.renderer, medium=medium))


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_one_mesh_contains_glass_and_content_in_world_coordinates(
    suffix: str, scene: TrainedScene, tmp_path: Path
) -> None:
    write(scene, "mesh", tmp_path / f"ball{suffix}")
    loaded = trimesh.load(tmp_path / f"ball{suffix}", process=False)
    distances = np.linalg.norm(loaded.vertices - INSIDE_CENTRE, axis=1)
    of_content = np.abs(distances - INSIDE_RADIUS) < CELL
    np.testing.assert_allclose(np.linalg.norm(loaded.vertices[~of_content], axis=1), RADIUS, atol=1e-4)
    colours = np.asarray(loaded.visual.vertex_colors)[:, :3]
    assert (colours[~of_content] == 255).all()
    expected = to_srgb(colour(torch.from_numpy(np.asarray(loaded.vertices[of_content]))))
    np.testing.assert_allclose(colours[of_content] / 255, expected, atol=0.01)


def test_glb_contains_each_body_with_its_material(two_bodies: TrainedScene, tmp_path: Path) -> None:
    write(two_bodies, "mesh", tmp_path / "two.glb")
    loaded = objects_of(tmp_path / "two.glb")
    for number, x in enumerate((-0.7, 0.7)):
        distances = np.linalg.norm(loaded[f"glass_{number}"].vertices - [x, 0, 0], axis=1)
        np.testing.assert_allclose(distances, 0.4, atol=4e-3)
    document = document_of(tmp_path / "two.glb")
    water, tinted = (material["extensions"] for material in document["materials"][:2])
    assert water["KHR_materials_dispersion"]["dispersion"] == pytest.approx(20 / 55.8, rel=2e-3)
    assert water["KHR_materials_ior"]["ior"] == pytest.approx(1.3334, abs=1e-4)
    assert "KHR_materials_dispersion" not in tinted
    volume = tinted["KHR_materials_volume"]
    transmitted = np.array(volume["attenuationColor"]) ** (1 / volume["attenuationDistance"])
    np.testing.assert_allclose(transmitted, np.exp([-0.5, -0.1, -0.2]), rtol=1e-6)
    assert "KHR_materials_dispersion" in document["extensionsUsed"]


def test_usdz_contains_the_scene_as_another_library_reads_it(two_bodies: TrainedScene, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="install the extra usd")
    geometry, shading = import_module("pxr.UsdGeom"), import_module("pxr.UsdShade")
    cameras = two_bodies.cameras("train")
    cameras = replace(cameras, fy=1.3 * cameras.fy, cx=cameras.cx + 3, cy=cameras.cy - 2)
    two_bodies = replace(two_bodies, training_cameras=cameras)
    write(two_bodies, "mesh", tmp_path / "two.usdz")
    stage = usd.Stage.Open(str(tmp_path / "two.usdz"))
    # Programs for augmented reality require these.
    assert geometry.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    with zipfile.ZipFile(tmp_path / "two.usdz") as package:
        assert {entry.compress_type for entry in package.infolist()} == {zipfile.ZIP_STORED}
        names = package.namelist()
        (tmp_path / "sky.exr").write_bytes(package.read(next(name for name in names if name.endswith(".exr"))))
    assert names[0].endswith(".usdc")
    for number, x in enumerate((-0.7, 0.7)):
        mesh = geometry.Mesh(stage.GetPrimAtPath(f"/scene/glass_{number}"))
        vertices = np.array(mesh.GetPointsAttr().Get()) @ Z_UP_TO_Y_UP
        np.testing.assert_allclose(np.linalg.norm(vertices - [x, 0, 0], axis=1), 0.4, atol=4e-3)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert trimesh.Trimesh(vertices, faces, process=False).volume > 0, "faces point outwards"
        normals = np.array(mesh.GetNormalsAttr().Get()) @ Z_UP_TO_Y_UP
        assert ((vertices - [x, 0, 0]) * normals).sum(-1).min() > 0.39, "and so do normals"

    def surface(name: str, context: str = "") -> dict[str, object]:
        material = shading.MaterialBindingAPI(stage.GetPrimAtPath(f"/scene/{name}")).ComputeBoundMaterial()[0]
        shader = material.ComputeSurfaceSource(*([context] if context else []))[0]
        return {"id": shader.GetShaderId()} | {entry.GetBaseName(): entry.Get() for entry in shader.GetInputs()}

    water, tinted = surface("glass_0", "mtlx"), surface("glass_1", "mtlx")
    assert water["id"] == "ND_standard_surface_surfaceshader"
    assert water["specular_IOR"] == pytest.approx(1.3334, abs=1e-4)
    assert water["transmission_dispersion"] == pytest.approx(55.8, rel=2e-3)
    assert tinted["transmission_dispersion"] == 0
    transmitted = np.array(tinted["transmission_color"]) ** (1 / tinted["transmission_depth"])
    np.testing.assert_allclose(transmitted, np.exp([-0.5, -0.1, -0.2]), rtol=1e-6)
    assert surface("glass_1")["id"] == "UsdPreviewSurface"
    assert surface("glass_1")["ior"] == pytest.approx(1.4)
    # The content emits its radiance.
    inside = geometry.Mesh(stage.GetPrimAtPath("/scene/inside"))
    vertices = np.array(inside.GetPointsAttr().Get()) @ Z_UP_TO_Y_UP
    np.testing.assert_allclose(
        np.array(inside.GetDisplayColorAttr().Get()), colour(torch.from_numpy(vertices)), atol=1e-4
    )
    # Cameras project a point to the pixel at which nerfro sees it.
    point = np.array([0.2, 0.1, -0.3])
    for view, pose in enumerate(cameras.camera_to_world.double().numpy()):
        frustum = geometry.Camera(stage.GetPrimAtPath(f"/scene/train_{view:03d}")).GetCamera().frustum
        seen = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        x, y, _ = seen.Transform((Z_UP_TO_Y_UP @ point).tolist())
        local = (point - pose[:, 3]) @ pose[:, :3]
        column = cameras.cx[view] - cameras.fx[view] * local[0] / local[2]
        row = cameras.cy[view] + cameras.fy[view] * local[1] / local[2]
        assert 0.5 * (1 + x) * cameras.width == pytest.approx(float(column), abs=1e-3)
        assert 0.5 * (1 - y) * cameras.height == pytest.approx(float(row), abs=1e-3)
    # The centre of an unrotated dome is +z, and -x is to the right of it (OpenEXR, "Environment Maps").
    sky, height = load_lat_long(tmp_path / "sky.exr"), two_bodies.sky_height
    turn = geometry.Xformable(stage.GetPrimAtPath("/scene/sky")).GetLocalTransformation()
    for row, column in ((0, 7), (height // 2, height), (height // 3, 3 * height // 2), (height - 1, 0)):
        latitude, longitude = math.pi * (0.5 - (row + 0.5) / height), math.pi * (1 - (column + 0.5) / height)
        flat = math.cos(latitude)
        local = [math.sin(longitude) * flat, math.sin(latitude), math.cos(longitude) * flat]
        direction = np.array(turn.TransformDir(local)) @ Z_UP_TO_Y_UP
        np.testing.assert_allclose(sky[row, column], sky_of(torch.from_numpy(direction)), atol=5e-3)


def test_glb_keeps_strong_absorption(scene: TrainedScene, tmp_path: Path) -> None:
    absorption = np.array([20.0, 120.0, 200.0])
    write(scene.with_(absorption=absorption.tolist()), "mesh", tmp_path / "dark.glb")
    document = document_of(tmp_path / "dark.glb")
    volume = document["materials"][0]["extensions"]["KHR_materials_volume"]
    transmitted = np.array(volume["attenuationColor"]) ** (0.01 / volume["attenuationDistance"])
    np.testing.assert_allclose(transmitted, np.exp(-0.01 * absorption), rtol=1e-5)


def test_export_and_import_bend_rays_equally(scene: TrainedScene, tmp_path: Path) -> None:
    shape = trimesh.creation.icosphere(4).apply_transform(np.diag([0.8, 0.6, 0.4, 1]))
    shape.export(tmp_path / "body.ply")
    medium = make_bodies(str(tmp_path / "body.ply"), 1.43, resolution=32, cache=False)
    changed = with_changed_scene(scene.renderer, medium=medium)
    changed.path_sampler = Snell("mesh")
    out = tmp_path / "scene.glb"
    write(replace(scene, renderer=changed), "mesh", out)
    again = make_bodies(str(out), resolution=32, cache=False)
    generator = torch.Generator().manual_seed(0)
    start = 3 * torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=-1)
    towards = torch.nn.functional.normalize(0.3 * torch.randn(500, 3, generator=generator) - start, dim=-1)
    first, second = (
        Snell("mesh")(make_rays(start, towards, m, 0.0, None), m).exit_directions.double() for m in (medium, again)
    )
    angle = torch.rad2deg(2 * torch.asin(0.5 * (first - second).norm(dim=-1)))
    assert angle.median() < 1e-4
    assert angle.quantile(0.98) < 1e-3


def test_small_bodies_keep_their_triangles_beside_large_ones() -> None:
    assert _divided([12, 40_000], 10_000) == [12, 9988]
    assert _divided([40_000, 500, 200_000], 10_000) == [4750, 500, 4750]


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "median", "most"), [("cube", 2e-3, 0.02), ("ball", 0.2, 0.6)])
def test_small_meshes_bend_rays_as_the_original(
    scene: TrainedScene, shape: str, median: float, most: float, tmp_path: Path
) -> None:
    pytest.importorskip("fast_simplification", reason="install the extra gltf")
    meshes = {"cube": trimesh.creation.box((1.2, 1.0, 0.8)), "ball": trimesh.creation.icosphere(5, 0.7)}
    meshes[shape].apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5)).export(tmp_path / "body.ply")
    medium = make_bodies(str(tmp_path / "body.ply"), 1.43, resolution=128, cache=False)
    changed = replace(scene, renderer=with_changed_scene(scene.renderer, medium=medium))
    assert len(changed.surface[0].faces) > 40_000
    write(changed, "mesh", tmp_path / "scene.glb")
    document = document_of(tmp_path / "scene.glb")
    indices = [mesh["primitives"][0]["indices"] for mesh in document["meshes"]]
    assert sum(document["accessors"][number]["count"] for number in indices) <= 3 * 20_000
    again = make_bodies(str(tmp_path / "scene.glb"), resolution=32, cache=False)
    generator = torch.Generator().manual_seed(0)
    start = 3 * torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    towards = torch.nn.functional.normalize(0.3 * torch.randn(2000, 3, generator=generator) - start, dim=-1)
    first, second = (
        Snell("mesh")(make_rays(start, towards, m, 0.0, None), m).exit_directions.double() for m in (medium, again)
    )
    angle = torch.rad2deg(2 * torch.asin(0.5 * (first - second).norm(dim=-1).clamp(max=2)))
    assert angle.median() < median
    assert angle.quantile(0.9) < most


@pytest.mark.slow
def test_mitsuba_accepts_strong_absorption(scene: TrainedScene, tmp_path: Path) -> None:
    write(scene.with_(absorption=[0.5, 1.0, 2.0]), "mitsuba", tmp_path / "dark.xml")
    medium = ElementTree.parse(tmp_path / "dark.xml").getroot().find("shape/medium")
    assert medium is not None
    numbers = {child.get("name"): np.array(str(child.get("value")).split(), float) for child in medium}
    assert numbers["sigma_t"].max() <= 1  # Mitsuba refuses larger colours
    np.testing.assert_allclose(numbers["sigma_t"] * numbers["scale"], [0.5, 1.0, 2.0], rtol=1e-6)


def with_box(scene: TrainedScene, half_side: float = 1.0) -> TrainedScene:
    """The scene with a cube as its space."""
    return replace(scene, renderer=with_changed_scene(scene.renderer, space=Box([[-half_side] * 3, [half_side] * 3])))


def test_mitsuba_scenes_need_no_glass(scene: TrainedScene, tmp_path: Path) -> None:
    write(with_box(scene.with_(glass=False)), "mitsuba", tmp_path / "straight.xml")
    root = ElementTree.parse(tmp_path / "straight.xml").getroot()
    assert [shape.get("id") for shape in root.findall("shape")] == ["inside"]


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_mitsuba_sensors_see_the_object_in_any_world_unit(
    scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    cameras = scene.cameras("test")
    poses = torch.cat([cameras.camera_to_world[..., :3], factor * cameras.camera_to_world[..., 3:]], -1)
    monkeypatch.setattr(TrainedScene, "cameras", lambda self, split: replace(cameras, camera_to_world=poses))
    write(with_box(scene.with_(glass=False, inside=False), factor), "mitsuba", tmp_path / "far.xml")
    for sensor in ElementTree.parse(tmp_path / "far.xml").getroot().findall("sensor"):
        clip = {child.get("name"): float(str(child.get("value"))) for child in sensor.findall("float")}
        assert clip["near_clip"] < factor * 2
        assert clip["far_clip"] > factor * 6


def test_mitsuba_scenes_contain_separate_bodies(two_bodies: TrainedScene, tmp_path: Path) -> None:
    write(two_bodies, "mitsuba", tmp_path / "two.xml")
    shapes = ElementTree.parse(tmp_path / "two.xml").getroot().findall("shape")
    indices = {shape.get("id"): shape.find("bsdf/float[@name='int_ior']").get("value") for shape in shapes[:2]}  # type: ignore[union-attr]
    assert {name: round(float(str(ior)), 3) for name, ior in indices.items()} == {"glass": 1.333, "glass_1": 1.4}
    assert [shape.find("medium") is not None for shape in shapes[:2]] == [False, True]
    for file, x in (("two_glass.ply", -0.7), ("two_glass_1.ply", 0.7)):
        np.testing.assert_allclose(trimesh.load(tmp_path / file).bounds.mean(0), [x, 0, 0], atol=1e-2)
    medium = two_bodies.renderer.scene.medium
    medium.grids[1].box.add_(torch.tensor([-1.0, 0, 0]))  # type: ignore[index, operator, union-attr]
    refused("inside others or overlap", write, two_bodies, "mitsuba", tmp_path / "overlapping.xml")


def test_crossed_bars_without_vertices_inside_each_other_overlap(scene: TrainedScene, tmp_path: Path) -> None:
    bodies = {}
    for name, sides in (("one", (1.4, 0.2, 0.2)), ("other", (0.2, 1.4, 0.2))):
        trimesh.creation.box(sides).export(tmp_path / f"{name}.ply")
        bodies[name] = {"mesh": str(tmp_path / f"{name}.ply"), "ior": 1.5}
    medium = make_bodies(bodies=bodies, resolution=32, cache=False)
    renderer = with_changed_scene(scene.renderer, medium=medium)
    renderer.path_sampler = Snell("mesh")
    refused(
        "inside others or overlap", write, replace(scene, renderer=renderer), "mitsuba", tmp_path / "overlapping.xml"
    )


@pytest.mark.slow
def test_mitsuba_sensors_that_differ_from_the_cameras_are_named(
    scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(scene, "mitsuba", tmp_path / "same.xml")
    assert "warning" not in capsys.readouterr().out
    cameras = scene.cameras("test")
    monkeypatch.setattr(TrainedScene, "cameras", lambda self, split: replace(cameras, fy=1.5 * cameras.fy))
    write(scene, "mitsuba", tmp_path / "tall.xml")
    assert "have no lens distortion and square pixels, unlike the cameras" in capsys.readouterr().out


VALIDATE = """const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]));
require("gltf-validator").validateBytes(bytes).then((report) => console.log(JSON.stringify(report)));"""


def validated(file: Path) -> dict:
    """What Khronos's own validator reports (npm's gltf-validator, where NODE_PATH has it)."""
    if shutil.which("node") is None:
        pytest.skip("Node.js is not installed")
    done = subprocess.run(["node", "-e", VALIDATE, str(file)], capture_output=True, text=True)
    if "Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("gltf-validator is not installed: npm install gltf-validator, and set NODE_PATH")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_glb_passes_khronos_validator(scene: TrainedScene, tmp_path: Path) -> None:
    write(scene.with_(absorption=[0.1, 0.2, 0.3]), "mesh", tmp_path / "ball.glb")
    report = validated(tmp_path / "ball.glb")
    assert report["issues"]["messages"] == []
    assert report["info"]["totalTriangleCount"] > 1000
    # The validator sees what is wrong.
    (tmp_path / "bad.glb").write_bytes((tmp_path / "ball.glb").read_bytes().replace(b'"SCALAR"', b'"VECTOR"'))
    assert validated(tmp_path / "bad.glb")["issues"]["numErrors"] > 0


@pytest.mark.parametrize("suffix", [".hdr", ".exr", ".png"])
def test_exported_sky_is_read_by_other_programs(scene: TrainedScene, suffix: str, tmp_path: Path) -> None:
    write(scene, "sky", tmp_path / f"sky{suffix}")
    if suffix == ".exr":
        picture = OpenImageIO.ImageBuf(str(tmp_path / "sky.exr")).get_pixels()
    elif suffix == ".hdr":
        picture = cv2.imread(str(tmp_path / "sky.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    else:
        with Image.open(tmp_path / "sky.png") as image:
            picture = to_linear(np.asarray(image) / 255)
    assert picture.shape == (48, 96, 3)
    polar, azimuth = math.pi * 10.5 / 48, math.pi - 2 * math.pi * 20.5 / 96
    towards = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
    np.testing.assert_allclose(picture[10, 20], sky_of(torch.tensor(towards)), atol=6e-3)


def test_exported_volume_is_the_field_at_the_vertices_of_a_grid(scene: TrainedScene, tmp_path: Path) -> None:
    write(scene, "volume", tmp_path / "inside.npz")
    with np.load(tmp_path / "inside.npz") as file:
        density, rgb, box = (file[name] for name in ("density", "rgb", "box"))
    assert density.shape == (48, 48, 48)
    places = np.stack(np.meshgrid(*np.linspace(*box, 48).T, indexing="ij"), -1)
    inside = np.linalg.norm(places - INSIDE_CENTRE, axis=-1) < INSIDE_RADIUS
    np.testing.assert_array_equal(density, 500.0 * inside)
    np.testing.assert_allclose(rgb[inside], colour(torch.from_numpy(places[inside])), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "suffix"), [("page", ".html"), ("volume", ".npz"), ("mesh", ".glb"), ("mitsuba", ".xml")]
)
def test_exported_volume_has_at_least_two_vertices_along_each_side(
    scene: TrainedScene, what: str, suffix: str, tmp_path: Path
) -> None:
    out = tmp_path / f"out{suffix}"
    refused("^resolution=1 is not allowed; take at least 2$", write, scene, what, out, resolution=1)
    assert not out.exists()
    write(scene, what, out, resolution=2)
    assert out.exists()


@pytest.mark.slow
@pytest.mark.parametrize(("glass", "least"), [("dielectric", 25), ("transmitting_glass", 32)])
def test_mitsuba_renders_the_same_image(
    scene: TrainedScene, mitsuba: ModuleType, glass: str, least: float, tmp_path: Path
) -> None:
    write(scene, "mitsuba", tmp_path / "ball.xml")
    named = {} if glass == "dielectric" else {"glass": glass}
    loaded = mitsuba.load_file(str(tmp_path / "ball.xml"), **named)
    assert len(loaded.sensors()) == len(scene.cameras())
    for view in range(2):
        linear = np.array(mitsuba.render(loaded, sensor=view, spp=64))[..., :3]
        picture = to_srgb(torch.from_numpy(linear)).clamp(0, 1)
        ours = scene.render(scene.cameras().select([view]), Subdivision(3)).rgb[0]
        assert -10 * torch.log10((picture - ours).square().mean()) > least


def test_cameras_and_points_are_read_by_nerfro_and_pycolmap(scene: TrainedScene, tmp_path: Path) -> None:
    bent = torch.tensor([[0.1, -0.02, 0.003, 0.0, 0.001, -0.002, 0.01, 0.02, 0.03]]).expand(3, 9)
    scene = replace(scene, training_cameras=replace(scene.cameras("train"), distortion=bent), source=Absent())
    expected = scene.cameras("train")
    for what in ("colmap", "cameras"):
        assert write(scene, what, tmp_path / what, resolution=32).startswith("3 cameras and ")
    model = read_colmap(tmp_path / "colmap" / "sparse" / "0")
    poses = np.stack([image.camera_to_world for image in model.images]) * [1.0, -1.0, -1.0, 1.0]
    np.testing.assert_allclose(poses, expected.camera_to_world, atol=1e-6)
    assert [image.name for image in model.images] == ["train_000.png", "train_001.png", "train_002.png"]
    lens = lens_of(model.cameras[model.images[1].camera], "-")
    assert (lens.fx, lens.cx) == pytest.approx((float(expected.fx[1]), float(expected.cx[1])))
    assert lens.distortion == pytest.approx(bent[0].tolist())
    # Points of the ball inside, with its colour.
    centre = model.points.mean(0)
    np.testing.assert_allclose(centre, INSIDE_CENTRE, atol=0.03)
    geometry = CaptureGeometry.of(expected, scene.bounds)
    again = read_cameras(tmp_path / "cameras" / "transforms.json", geometry)
    torch.testing.assert_close(again.camera_to_world, expected.camera_to_world)
    torch.testing.assert_close(again.distortion, bent.clone())
    assert len(trimesh.load(tmp_path / "cameras" / "points.ply").vertices) == len(model.points)

    pycolmap = pytest.importorskip("pycolmap")
    opened = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert (opened.num_images(), opened.num_points3D()) == (3, len(model.points))
    for image in opened.images.values():
        view = [image.name for image in model.images].index(image.name)
        np.testing.assert_allclose(image.projection_center(), expected.camera_to_world[view, :, 3], atol=1e-6)


class Absent(Photographs):
    """Data that have moved."""

    root = Path("/nowhere")


@pytest.mark.parametrize(
    ("what", "name", "message"),
    [
        ("colmap", "a.txt", "must be a folder"),
        ("fog", "a.glb", "what=fog is not known; choose .*colmap"),
        ("mesh", "a.stl", "must end in .glb"),
        ("volume", "a.vdb", "must end in .npz"),
    ],
)
def test_unknown_exports_and_endings_are_refused(what: str, name: str, message: str) -> None:
    refused(message, find_export, what, Path(name))


@pytest.mark.parametrize(
    ("what", "option"),
    [
        ("page", "half_depth=1"),
        ("sky", "half_depth=1"),
        ("sky", "gaussians=99"),
        ("volume", "sky=a.hdr"),
        ("page", "triangles=500"),
    ],
)
def test_option_without_effect_on_an_export_is_refused(
    what: str, option: str, run_here: Runner, tmp_path: Path
) -> None:
    out = tmp_path / f"file{export_of(what).suffixes[0]}"
    exported = run_here("export", "checkpoint=none", f"what={what}", f"out={out}", option, code=1)
    assert f"has no effect with what={what}; remove it" in exported.error
