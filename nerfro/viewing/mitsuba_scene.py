"""A trained scene as one that Mitsuba renders: glass, what is inside, sky and cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Float

from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.deep_images import write_radiance
from nerfro.files.ply import write_ply
from nerfro.media.solid import Solid
from nerfro.scenes.path_tracer import envmap_texture
from nerfro.viewing.changes import absorption_of
from nerfro.viewing.meshes import find_solid, with_normals
from nerfro.viewing.trained_scene import SKY_HEIGHT, TrainedScene

_MAX_DEPTH, _SAMPLES = 64, 64
# Mitsuba's skies stand on edge (y up); this turns y to our z.
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def write_mitsuba(scene: TrainedScene, out: Path, resolution: int, half_depth: float) -> str:
    """Write OUT.xml, and OUT_glass.ply, OUT_inside.ply and OUT_sky.hdr beside it.

    Glass is Mitsuba's `dielectric`, which also reflects in part; the parameter `glass` names another material, such as
    `transmitting_glass` (see `scenes.glass`) for a model without partial reflection. What is inside shines with the
    radiance that it is seen with from in front, and nothing lights it again. The test cameras are the sensors, in
    their order.

    Raises:
        NerfroError: bodies lie inside bodies.
    """
    glass = scene.surface if isinstance(scene.renderer.scene.medium, Solid) else []
    if len(glass) > 1:
        raise NerfroError("bodies inside bodies are not written for Mitsuba; write them with what=mesh")
    solid = find_solid(scene, resolution, half_depth)
    absorption = absorption_of(scene.renderer.scene)
    root = ElementTree.Element("scene", version="3.0.0")
    _add(_add(root, "integrator", type="volpath" if absorption.any() else "path"), "integer", name="max_depth",
         value=str(_MAX_DEPTH))  # fmt: skip
    _add_sky(root, scene, out.with_name(f"{out.stem}_sky.hdr"))
    if glass:
        _add(root, "default", name="glass", value="dielectric")
        shape = _add_mesh(root, out.with_name(f"{out.stem}_glass.ply"), *with_normals(glass[0]))
        _add(_add(shape, "bsdf", type="$glass"), "float", name="int_ior", value=f"{float(scene.ior[0]):g}")
        if absorption.any():
            _add_absorption(shape, absorption[0].tolist())
    if solid is not None:
        colours = dict(zip("rgb", solid.radiance.numpy().T, strict=True))
        file, normals = out.with_name(f"{out.stem}_inside.ply"), solid.normals.numpy()
        shape = _add_mesh(root, file, solid.mesh.vertices, solid.mesh.faces, normals, colours)
        # A black mirror and not a black diffuser, which would send out shadow rays for nothing.
        black = _add(shape, "bsdf", type="conductor")
        _add(black, "string", name="material", value="none")
        _add(black, "rgb", name="specular_reflectance", value="0")
        light = _add(_add(shape, "emitter", type="area"), "texture", type="mesh_attribute", name="radiance")
        _add(light, "string", name="name", value="vertex_color")
    cameras = scene.cameras("test").to("cpu")
    for view in range(len(cameras)):
        _add_sensor(root, cameras, view)
    ElementTree.indent(root)
    write_atomically(out, ElementTree.tostring(root, encoding="unicode") + "\n")
    inside = "nothing" if solid is None else f"{len(solid.mesh.faces)} triangles"
    return f"a scene of {len(cameras)} sensors with {inside} inside"


def files_beside(out: Path) -> list[Path]:
    """All that `write_mitsuba` may write."""
    return [out, *(out.with_name(f"{out.stem}_{part}") for part in ("glass.ply", "inside.ply", "sky.hdr"))]


def _add_sky(root: ElementTree.Element, scene: TrainedScene, file: Path) -> None:
    def sky(directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        flat = torch.from_numpy(directions.reshape(-1, 3)).float()
        return scene.seen_beyond(flat).numpy().reshape(directions.shape)

    write_radiance(file, envmap_texture(sky, 2 * SKY_HEIGHT, _UPRIGHT))
    emitter = _add(root, "emitter", type="envmap")
    _add(emitter, "string", name="filename", value=file.name)
    _add(_add(emitter, "transform", name="to_world"), "matrix", value=_matrix(_UPRIGHT, np.zeros(3)))


def _add_mesh(
    root: ElementTree.Element,
    file: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    columns: Mapping[str, np.ndarray] | None = None,
) -> ElementTree.Element:
    properties = dict(zip(("nx", "ny", "nz"), normals.T, strict=True)) | dict(columns or {})
    write_ply(file, vertices, faces, properties)
    shape = _add(root, "shape", type="ply", id=file.stem)
    _add(shape, "string", name="filename", value=file.name)
    return shape


def _add_absorption(shape: ElementTree.Element, absorption: list[float]) -> None:
    medium = _add(shape, "medium", type="homogeneous", name="interior")
    _add(medium, "rgb", name="sigma_t", value=" ".join(f"{value:g}" for value in absorption))
    _add(medium, "rgb", name="albedo", value="0")


def _add_sensor(root: ElementTree.Element, cameras: Cameras, view: int) -> None:
    """A pinhole of square pixels: a lens's distortion is left out."""
    sensor = _add(root, "sensor", type="perspective", id=f"test_{view:03d}")
    width, height = cameras.width, cameras.height
    angle = math.degrees(2 * math.atan(0.5 * width / float(cameras.fx[view])))
    _add(sensor, "string", name="fov_axis", value="x")
    offsets = {"x": 0.5 - float(cameras.cx[view]) / width, "y": 0.5 - float(cameras.cy[view]) / height}
    numbers = {"fov": angle, "near_clip": 0.01, "far_clip": 1000.0}
    numbers |= {f"principal_point_offset_{axis}": offset for axis, offset in offsets.items()}
    for name, value in numbers.items():
        _add(sensor, "float", name=name, value=f"{value:.9g}")
    pose = cameras.camera_to_world[view].double().numpy()
    # Mitsuba's cameras look along +z with x to the left; ours look along -z with x to the right.
    _add(_add(sensor, "transform", name="to_world"), "matrix", value=_matrix(pose[:, :3] * [-1, 1, -1], pose[:, 3]))
    film = _add(sensor, "film", type="hdrfilm")
    for name, value in (("width", width), ("height", height)):
        _add(film, "integer", name=name, value=str(value))
    _add(film, "rfilter", type="box")
    _add(_add(sensor, "sampler", type="independent"), "integer", name="sample_count", value=str(_SAMPLES))


def _matrix(rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> str:
    rows = np.vstack([np.column_stack([rotation, shift]), [0, 0, 0, 1]])
    return " ".join(f"{value:.9g}" for value in rows.flat)


def _add(parent: ElementTree.Element, kind: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, kind, attributes)
