"""Export of a trained scene for Mitsuba 3: glass, dense content, sky and test cameras."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, warn
from nerfro.exports.meshes import glass_meshes, inside_mesh
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.files.images import write_radiance
from nerfro.files.lat_long import envmap_texture
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.page import page_split
from nerfro.viewing.surface import surface_of
from nerfro.viewing.trained_scene import TrainedScene, absorption_of

if TYPE_CHECKING:
    import trimesh

MITSUBA_FILES = ("_glass.ply", "_inside.ply", "_sky.hdr")  # endings of the files beside the .xml
# Clip distances of the sensors, relative to the largest distance between a camera and a corner of the object's bounds.
_NEAR_CLIP, _FAR_CLIP = 1e-4, 1e2
_MIN_SKY_HEIGHT = 1024
_SQUARE = 1e-3  # relative difference of the focal lengths up to which pixels count as square
# The y axis is up in an environment map of Mitsuba, and the z axis in nerfro.
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_ELEMENTS = {
    "path": "integrator", "volpath": "integrator", "envmap": "emitter", "area": "emitter", "ply": "shape",
    "homogeneous": "medium", "mesh_attribute": "texture", "perspective": "sensor", "hdrfilm": "film", "box": "rfilter",
    "independent": "sampler",
}  # fmt: skip


def write_mitsuba(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write an .xml scene, with meshes and sky beside the file (`MITSUBA_FILES`).

    The glass is a `dielectric`, with partial reflection; the parameter `glass` selects another material, such as
    `transmitting_glass` (see `nerfro/synthetic/glass.py`) for a model without partial reflection. The content
    is a light source with the radiance that is seen from outside. The sensors are the test cameras in their order, or
    the cameras of another split if there are no test cameras.

    Raises:
        NerfroError: bodies lie inside others or overlap.
    """
    scene.cameras("train").refuse_turntable("what=mitsuba has one sky for all cameras", "take what=mesh and what=sky")
    glass, inside = glass_meshes(scene), inside_mesh(scene, options.resolution, options.half_depth)
    if len(glass) > 1:
        _require_apart(scene)
    split = page_split(scene)
    cameras, absorption = scene.cameras(split).to("cpu"), absorption_of(scene.renderer.scene)
    glass_file, inside_file, sky_file = (out.with_name(out.stem + ending) for ending in MITSUBA_FILES)
    objects: dict[str, Any] = {
        "integrator": {"type": "volpath" if absorption.any() else "path", "max_depth": 64},
        "sky": {"type": "envmap", "filename": sky_file.name, "to_world": _Y_UP_TO_Z_UP},
    }
    glass_files = [glass_file, *(out.with_name(f"{out.stem}_glass_{body}.ply") for body in range(1, len(glass)))]
    refuse_existing(glass_files[1:], options.overwrite)
    corners = torch.cartesian_prod(*scene.bounds.T.float())
    reach = float(torch.cdist(cameras.camera_to_world[..., 3].float(), corners).max())
    _write_sky(sky_file, scene)
    for body, (mesh, file) in enumerate(zip(glass, glass_files, strict=False)):
        bsdf = {"type": "$glass", "int_ior": float(scene.ior[body]), "ext_ior": 1.0}
        shape = {**_write_shape(file, mesh), "bsdf": bsdf}
        if absorption[body].any():
            # Mitsuba accepts colours up to 1 only, and multiplies them by the scale.
            scale = float(absorption[body].max())
            sigma_t = tuple((absorption[body] / scale).tolist())
            medium = {"type": "homogeneous", "sigma_t": sigma_t, "scale": scale, "albedo": (0.0, 0.0, 0.0)}
            shape["interior"] = medium
        objects[f"glass_{body}" if body else "glass"] = shape
    if inside is not None:
        radiance = np.asarray(inside.vertex_attributes.pop("radiance"))
        inside.vertex_attributes.update(zip("rgb", radiance.T, strict=True))
        # A black mirror and not a black diffuser, for which the integrator would trace useless shadow rays.
        black = {"type": "conductor", "material": "none", "specular_reflectance": (0.0, 0.0, 0.0)}
        light = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}}
        objects["inside"] = {**_write_shape(inside_file, inside), "bsdf": black, "emitter": light}
    _warn_of_lenses(cameras)
    objects |= {f"{split}_{view:03d}": _sensor(cameras, view, reach) for view in range(len(cameras))}
    root = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(root, "default", name="glass", value="dielectric")
    for name, value in objects.items():
        _append(root, name, value)
    ElementTree.indent(root)
    write_atomically(out, ElementTree.tostring(root, encoding="unicode") + "\n")
    content = "nothing" if inside is None else f"{len(inside.faces)} triangles"
    return f"a scene of {len(cameras)} sensors with {content} inside"


def _require_apart(scene: TrainedScene) -> None:
    """Refuse bodies that lie inside others or overlap, which a `dielectric` of Mitsuba cannot describe."""
    bodies = scene.renderer.scene.medium.bodies
    assert bodies is not None
    # The triangles of a mesh may be too large for a test of their vertices.
    for body, mesh in enumerate(surface_of(bodies, triangles=False)):
        phi, _ = bodies.signed_distances(torch.from_numpy(mesh.vertices).to(bodies.box))
        phi[:, body] = torch.inf
        if (phi < 0).any():
            raise NerfroError(
                "bodies that lie inside others or overlap are not written for Mitsuba; write them with what=mesh"
            )


def _write_sky(file: Path, scene: TrainedScene) -> None:
    def sky(directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        flat = torch.from_numpy(directions.reshape(-1, 3)).float()
        return scene.background(flat).numpy().reshape(directions.shape)

    write_radiance(file, envmap_texture(sky, max(_MIN_SKY_HEIGHT, scene.sky_height), _Y_UP_TO_Z_UP[:3, :3]))


def _write_shape(file: Path, mesh: trimesh.Trimesh) -> dict[str, Any]:
    from trimesh.exchange.ply import export_ply

    write_atomically(file, export_ply(mesh, vertex_normal=True))
    return {"type": "ply", "filename": file.name}


def _warn_of_lenses(cameras: Cameras) -> None:
    """Print a warning if the sensors cannot represent the lenses of the cameras."""
    distorted = cameras.distortion is not None and bool(cameras.distortion.any())
    if distorted or not torch.allclose(cameras.fx, cameras.fy, rtol=_SQUARE):
        warn(
            "the sensors for Mitsuba have no lens distortion and square pixels, unlike the cameras; undistort the "
            "photographs before the training for equal images"
        )


def _sensor(cameras: Cameras, view: int, reach: float) -> dict[str, Any]:
    """Describe a pinhole camera with square pixels, at most `reach` from the object; lens distortion is omitted."""
    # Mitsuba's cameras look along +z with x to the left, and nerfro's cameras along -z with x to the right.
    to_world = np.eye(4)
    to_world[:3] = cameras.camera_to_world[view].double().numpy() * [-1, 1, -1, 1]
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(0.5 * cameras.width / float(cameras.fx[view]))),
        "near_clip": _NEAR_CLIP * reach,
        "far_clip": _FAR_CLIP * reach,
        "principal_point_offset_x": 0.5 - float(cameras.cx[view]) / cameras.width,
        "principal_point_offset_y": 0.5 - float(cameras.cy[view]) / cameras.height,
        "to_world": to_world,
        "film": {"type": "hdrfilm", "width": cameras.width, "height": cameras.height, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 64},
    }


def _append(parent: ElementTree.Element, name: str, value: Any) -> None:
    """Append an object or a parameter in the form of Mitsuba's dictionaries to an XML element."""
    if isinstance(value, dict):
        identifier = "id" if parent.tag == "scene" else "name"
        attributes = {"type": value["type"], identifier: name}
        element = ElementTree.SubElement(parent, _ELEMENTS.get(value["type"], "bsdf"), attributes)
        for key, item in value.items():
            if key != "type":
                _append(element, key, item)
    elif isinstance(value, np.ndarray):
        transform = ElementTree.SubElement(parent, "transform", name=name)
        ElementTree.SubElement(transform, "matrix", value=_numbers(value.flat))
    else:
        tag = {tuple: "rgb", int: "integer", float: "float", str: "string"}[type(value)]
        text = value if isinstance(value, str) else _numbers(value if isinstance(value, tuple) else [value])
        ElementTree.SubElement(parent, tag, name=name, value=text)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


EXPORTS["mitsuba"] = Export((".xml",), write_mitsuba, MITSUBA_FILES, ("resolution", "half_depth", "sky"))
