"""Export of glass, dense content and Gaussians in glTF format, with glass materials and cameras."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn import functional

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, optional
from nerfro.core.light import to_linear
from nerfro.exports.gaussians import HARMONIC_0, Gaussians
from nerfro.exports.meshes import attenuation, glass_meshes, inside_mesh, one_mesh
from nerfro.exports.usd import encode_usdz, openusd
from nerfro.files.atomic import write_atomically
from nerfro.files.lat_long import save_lat_long
from nerfro.files.templates import fill_template
from nerfro.geometry.gltf import QUANTIZATION, Z_UP_TO_Y_UP
from nerfro.media.material import Dispersion
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene, absorption_of

if TYPE_CHECKING:
    import trimesh

DEFAULT_TRIANGLES = 20_000  # limit of files with materials
_SPLATTING = "KHR_gaussian_splatting"
# Codes of glTF 2.0, sections 3.6.2.2 and 5.11: types of components, and targets of buffers.
_CODES = {"<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_VERTICES, _INDICES = 34962, 34963


def write_mesh(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write the surfaces of glass and dense content, with materials (.glb, .usdz) or as one mesh (.ply, .obj).

    Files with materials have the training cameras. The sky is written beside the file, and beside a .glb the page that
    shows both.
    """
    suffix, limit = out.suffix.lower(), options.triangles
    if suffix == ".usdz":
        openusd("Usd")
    if limit is not None:
        optional("fast_simplification", "gltf", "triangles= needs fast-simplification")
    elif suffix in (".glb", ".usdz"):
        limit = DEFAULT_TRIANGLES
    glass = glass_meshes(scene, limit)
    rest = None if limit is None else max(limit - sum(len(mesh.faces) for mesh in glass), limit // 2)
    inside = inside_mesh(scene, options.resolution, options.half_depth, rest)
    if not glass and inside is None:
        raise NerfroError("the scene has neither glass nor dense content to write; raise half_depth")
    if suffix == ".glb":
        write_atomically(out, encode_glb(scene, glass, inside))
        write_atomically(out.with_name(out.stem + "_viewer.html"), _viewer_page(scene, out))
    elif suffix == ".usdz":
        write_atomically(out, encode_usdz(scene, glass, inside))
    else:
        write_atomically(out, one_mesh(glass, inside, suffix))
    save_lat_long(out.with_name(out.stem + "_sky.hdr"), scene.sky)
    content = "nothing solid inside" if inside is None else f"{len(inside.faces)} triangles inside"
    return f"{sum(len(mesh.faces) for mesh in glass)} triangles of glass, {content}"


def encode_glb(
    scene: TrainedScene,
    glass: list[trimesh.Trimesh],
    inside: trimesh.Trimesh | None,
    gaussians: Gaussians | None = None,
) -> bytes:
    """Encode the surfaces of the bodies, dense content, Gaussians and training cameras as .glb."""
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "nerfro"}, "scene": 0, "scenes": [{}], "nodes": [], "meshes": [],
        "materials": [], "cameras": [], "accessors": [], "bufferViews": [],
    }  # fmt: skip
    content = bytearray()
    bodies = scene.renderer.scene.medium.bodies
    materials = [] if bodies is None else bodies.materials
    for number, (mesh, absorption) in enumerate(zip(glass, absorption_of(scene.renderer.scene), strict=True)):
        material = _glass_material(mesh, float(scene.ior[number]), absorption.numpy(), materials[number].dispersion)
        _add_mesh(document, content, f"glass_{number}", mesh, material)
    if inside is not None:
        # The colours are radiance and not albedo, so lights of the other program must not shade them again.
        _add_mesh(document, content, "inside", inside, {"extensions": {"KHR_materials_unlit": {}}})
    if gaussians is not None:
        _add_gaussians(document, content, gaussians)
    _add_cameras(document, scene.cameras("train").to("cpu"))
    document["scenes"][0]["nodes"] = list(range(len(document["nodes"])))
    extensions = {name for material in document["materials"] for name in material["extensions"]}
    extensions |= set() if gaussians is None else {_SPLATTING}
    required = [] if inside is None else [QUANTIZATION]
    document |= {"extensionsUsed": sorted({*required, *extensions}), "extensionsRequired": required}
    document["buffers"] = [{"byteLength": len(content)}]
    text = json.dumps({key: value for key, value in document.items() if value != []}, separators=(",", ":")).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(content))]
    body = b"".join(len(data).to_bytes(4, "little") + kind + data for kind, data in chunks)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def _add_mesh(
    document: dict[str, Any], content: bytearray, name: str, mesh: trimesh.Trimesh, material: dict[str, Any]
) -> None:
    """Add a mesh. Light bends at glass, which has single precision; content with radiance has 16 bits for each number.

    The matrix of the node restores positions of 16 bits.
    """
    origin, unit = np.zeros(3), 1.0
    values = {"POSITION": ("<f4", mesh.vertices), "NORMAL": ("<f4", mesh.vertex_normals)}
    if "radiance" in mesh.vertex_attributes:
        origin, unit = mesh.bounds[0], float(mesh.extents.max()) / 65535
        values = {
            "POSITION": ("<u2", np.rint((mesh.vertices - origin) / unit)),
            "NORMAL": ("<i2", np.rint(32767 * mesh.vertex_normals)),
            "COLOR_0": ("<u2", np.rint(65535 * np.clip(mesh.vertex_attributes["radiance"], 0, 1))),
        }
    # Attributes begin at multiples of four bytes, so each has a fourth, unused component.
    vertices = np.zeros(len(mesh.vertices), [(key, code, 4) for key, (code, _) in values.items()])
    attributes = {}
    for number, (key, (code, numbers)) in enumerate(values.items()):
        vertices[key][:, :3] = numbers
        attributes[key] = len(document["accessors"])
        entry = {
            "type": "VEC3",
            "componentType": _CODES[code],
            "byteOffset": number * vertices[key].dtype.itemsize * 4,
            "count": len(vertices),
        }
        if key == "POSITION":
            corners = vertices[key][:, :3]
            entry |= {"min": corners.min(0).tolist(), "max": corners.max(0).tolist()}
        elif code != "<f4":
            entry["normalized"] = True
        document["accessors"].append({"bufferView": len(document["bufferViews"]), **entry})
    _add_view(document, content, vertices.tobytes(), target=_VERTICES, byteStride=vertices.itemsize)
    code = "<u2" if len(vertices) < 65536 - 1 else "<u4"  # the largest number is reserved
    entry = {"type": "SCALAR", "componentType": _CODES[code], "count": mesh.faces.size}
    document["accessors"].append({"bufferView": len(document["bufferViews"]), **entry})
    _add_view(document, content, mesh.faces.astype(code).tobytes(), target=_INDICES)
    indices = len(document["accessors"]) - 1
    _add_node(document, name, {"attributes": attributes, "indices": indices}, material, unit, origin)


def _add_gaussians(document: dict[str, Any], content: bytearray, gaussians: Gaussians) -> None:
    """Add Gaussians as points (KHR_gaussian_splatting), with colours for programs without the extension."""
    opacities, rotations = gaussians.logits.sigmoid()[:, None], functional.normalize(gaussians.rotations, dim=-1)
    colours = to_linear((0.5 + HARMONIC_0 * gaussians.harmonics[:, 0]).clamp(0, 1))
    values = {
        "POSITION": gaussians.positions,
        "COLOR_0": torch.cat([colours, opacities], -1),
        f"{_SPLATTING}:SCALE": gaussians.log_scales,
        f"{_SPLATTING}:ROTATION": rotations[:, [1, 2, 3, 0]],
        f"{_SPLATTING}:OPACITY": opacities,
        f"{_SPLATTING}:SH_DEGREE_0_COEF_0": gaussians.harmonics[:, 0],
    } | {f"{_SPLATTING}:SH_DEGREE_1_COEF_{n}": gaussians.harmonics[:, 1 + n] for n in range(3)}
    attributes = {}
    for name, numbers in values.items():
        attributes[name] = len(document["accessors"])
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[numbers.shape[1]]
        entry = {"type": kind, "componentType": _CODES["<f4"], "count": len(numbers)}
        if name == "POSITION":
            entry |= {"min": numbers.amin(0).tolist(), "max": numbers.amax(0).tolist()}
        document["accessors"].append({"bufferView": len(document["bufferViews"]), **entry})
        _add_view(document, content, numbers.numpy().astype("<f4").tobytes(), target=_VERTICES)
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {_SPLATTING: kernel}}
    _add_node(document, "gaussians", primitive, {"extensions": {"KHR_materials_unlit": {}}})


def _add_node(
    document: dict[str, Any],
    name: str,
    primitive: dict[str, Any],
    material: dict[str, Any],
    unit: float = 1.0,
    origin: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
) -> None:
    """Add a node with a mesh of one primitive and its material, whose coordinates have a unit and an origin."""
    matrix = np.eye(4)
    matrix[:3] = Z_UP_TO_Y_UP @ np.column_stack([unit * np.eye(3), origin])
    primitive |= {"material": len(document["materials"])}
    document["nodes"].append({"name": name, "mesh": len(document["meshes"]), "matrix": matrix.T.flatten().tolist()})
    document["meshes"].append({"name": name, "primitives": [primitive]})
    document["materials"].append({"name": name, **material})


def _add_view(document: dict[str, Any], content: bytearray, data: bytes, **settings: int) -> None:
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(content), "byteLength": len(data), **settings})
    content += data + bytes(-len(data) % 4)


def _add_cameras(document: dict[str, Any], cameras: Cameras) -> None:
    """Add pinhole cameras, whose axes are those of glTF; lens distortion and principal point are omitted."""
    for view, pose in enumerate(cameras.camera_to_world.double().numpy()):
        name, matrix = f"train_{view:03d}", np.eye(4)
        matrix[:3] = Z_UP_TO_Y_UP @ pose
        tangents = 0.5 * cameras.width / float(cameras.fx[view]), 0.5 * cameras.height / float(cameras.fy[view])
        lens = {
            "yfov": 2 * math.atan(tangents[1]),
            "aspectRatio": tangents[0] / tangents[1],
            "znear": max(float(cameras.near), 1e-3 * float(cameras.far)),
        }
        document["nodes"].append({"name": name, "camera": view, "matrix": matrix.T.flatten().tolist()})
        document["cameras"].append({"name": name, "type": "perspective", "perspective": lens})


def _viewer_page(scene: TrainedScene, file: Path) -> str:
    """Return a page that shows a .glb and its sky by Google's element <model-viewer>, from the training cameras.

    The element has the y axis up, and orbits a target at an azimuth from z towards x and a polar angle from y.
    """
    cameras, centre = scene.cameras("train").to("cpu"), scene.bounds.mean(0).double().numpy()
    views, reach = [], 0.0
    for view, pose in enumerate(cameras.camera_to_world.double().numpy()):
        back, eye = pose[:, 2], pose[:, 3]
        distance = max(float(back @ (eye - centre)), 1e-3)  # to the point of the optical axis closest to the centre
        reach = max(reach, 2 * distance)  # limits the depths that the element shows
        x, y, z = Z_UP_TO_Y_UP @ back
        angles = math.degrees(math.atan2(x, z)), math.degrees(math.acos(min(max(y, -1), 1)))
        target = Z_UP_TO_Y_UP @ (eye - distance * back)
        field_of_view = 2 * math.degrees(math.atan(0.5 * cameras.height / float(cameras.fy[view])))
        of_element = {
            "cameraOrbit": f"{angles[0]:.4f}deg {angles[1]:.4f}deg {distance:.6g}m",
            "cameraTarget": " ".join(f"{value:.6g}m" for value in target),
            "fieldOfView": f"{field_of_view:.4f}deg",
        }
        views.append({"name": f"train_{view:03d}", "view": of_element})
    template, sky = Path(__file__).with_name("model_viewer.html.jinja"), f"{file.stem}_sky.hdr"
    title = scene.name or file.stem
    return fill_template(template, title=title, model=file.name, sky=sky, cameras=views, reach=reach)


def _glass_material(
    mesh: trimesh.Trimesh, ior: float, absorption: np.ndarray, dispersion: Dispersion | None
) -> dict[str, Any]:
    """Describe glass by the extensions KHR_materials_transmission, _ior, _volume and _dispersion (Khronos)."""
    volume: dict[str, Any] = {"thicknessFactor": float(mesh.extents.min())}
    if absorption.any():
        distance, colour = attenuation(absorption)
        volume |= {"attenuationDistance": distance, "attenuationColor": colour}
    extensions: dict[str, Any] = {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_ior": {"ior": ior},
        "KHR_materials_volume": volume,
    }
    if dispersion is not None:
        extensions["KHR_materials_dispersion"] = {"dispersion": 20 / dispersion.abbe}
    return {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.0}, "extensions": extensions}


EXPORTS["mesh"] = Export(
    (".glb", ".usdz", ".ply", ".obj"),
    write_mesh,
    ("_sky.hdr", "_viewer.html"),
    ("resolution", "half_depth", "triangles", "sky"),
)
