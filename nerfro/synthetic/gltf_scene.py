"""Scenes of glTF files: refractive materials become bodies, and all others diffuse contents."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import trimesh

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_srgb
from nerfro.core.paths import user_path
from nerfro.files.reading import reading
from nerfro.geometry.bodies import crossings
from nerfro.geometry.gltf import (
    Z_UP_TO_Y_UP,
    Primitive,
    files_beside,
    primitives_of,
    read_document,
    require_readable,
    world_nodes,
)
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import merge_vertices
from nerfro.media.body_settings import BodySettings
from nerfro.rendering.scene_file import SCENE, SceneFile
from nerfro.synthetic.dataset import PlannedImage, ViewSplits, look_at_origin
from nerfro.synthetic.path_tracer import Pinhole
from nerfro.synthetic.scene import Part, SurfaceMesh, SyntheticScene, join
from nerfro.synthetic.scenes import torus

_DISTANCE = 3.1  # of the cameras of an orbit, in half diagonals of the bodies
# Shares of the cameras of a file for training, validation and test, by the number of the camera.
_SPLIT_OF = ("test", *3 * ("train",), "val", *3 * ("train",))


@dataclass(frozen=True)
class GltfViews(ViewSplits):
    """Views of a glTF file, with a mesh for each body and a scene file."""

    FILES = (*ViewSplits.FILES, "bodies/*.ply", SCENE)
    FACTS: ClassVar[dict[str, Any]] = {}

    @cached_property
    def _cameras(self) -> list[tuple[Mapping[str, Any], np.ndarray]]:
        """Perspective cameras of the file with their poses, z axis up."""
        document, turn = read_document(user_path(self.options.scene)), np.eye(4)
        turn[:3, :3] = Z_UP_TO_Y_UP.T
        cameras = document.get("cameras", [])
        poses = [(cameras[node["camera"]], turn @ m) for node, m in world_nodes(document) if "camera" in node]
        return [(camera["perspective"], _without_scale(pose)) for camera, pose in poses if "perspective" in camera]

    @property
    def camera(self) -> Pinhole:
        if self.options.cameras != "file":
            return super().camera
        lenses = {(lens["yfov"], lens.get("aspectRatio", 1.0)) for lens, _ in self._cameras}
        if len(lenses) != 1:
            raise NerfroError(
                f"cameras=file needs perspective cameras with one field of view, and {self.options.scene} has "
                f"{len(lenses)} different ones; choose cameras=orbit"
            )
        ((angle, aspect),) = lenses
        width, height = self.options.resolution, round(self.options.resolution / aspect)
        return Pinhole(width, height, 0.5 * height / np.tan(0.5 * angle), 0.5 * width, 0.5 * height)

    @property
    def angle_x(self) -> float:
        return self.camera.angle_x if self.options.cameras == "file" else super().angle_x

    def planned(self) -> list[PlannedImage]:
        if self.options.cameras != "file":
            return [replace(image, pose=self._moved(image.pose)) for image in super().planned()]
        planned = []
        for number, (_, pose) in enumerate(self._cameras):
            split = _SPLIT_OF[number % len(_SPLIT_OF)] if len(self._cameras) > 1 else "train"
            spp = self.options.test_spp if split == "test" else self.options.spp
            planned.append(self._planned(f"{split}/r_{number:03d}", pose, spp, self.options.seed * 300_000 + number))
        return planned

    def _moved(self, pose: np.ndarray) -> np.ndarray:
        """Move a camera from the orbit of the built-in scenes to that around the bodies."""
        half = 0.5 * np.linalg.norm(np.ptp(self.scene.glass.vertices, axis=0))
        moved = look_at_origin(_DISTANCE * half * pose[:3, 2])
        moved[:3, 3] += self.scene.aim
        return moved

    def finish(self, planned: list[PlannedImage]) -> None:
        centres = np.stack([image.pose[:3, 3] for image in planned])
        vertices = np.concatenate([part.surface.vertices for part in self.scene.parts])
        distances = np.linalg.norm(vertices - np.asarray(self.scene.aim), axis=1)
        orbit = np.linalg.norm(centres - np.asarray(self.scene.aim), axis=1)
        nearest = max(0.05 * orbit.min(), 0.9 * (orbit.min() - distances.max()))
        data: dict[str, Any] = {"type": "blender", "root": str(self.folder)}
        data |= {"near": float(nearest), "far": float(1.1 * (orbit.max() + distances.max()))}
        bodies = {}
        for part in self.scene.parts:
            if part.ior is None:
                continue
            mesh = self.folder / "bodies" / f"{part.name}.ply"
            part.surface.save(mesh)
            absorption = [float(value) for value in part.absorption] if any(part.absorption) else []
            # The images show no dispersion, so the bodies have no Abbe number.
            bodies[part.name] = BodySettings(mesh=str(mesh), ior=part.ior, absorption=absorption)
        SceneFile(data=data, bodies=bodies).save(self.folder / SCENE)
        super().finish(planned)

    def next_command(self) -> str:
        return f"train on it: {command_line('train', as_overrides({'scene': self.folder / SCENE}))}"


class GltfScene:
    """Scene of a glTF file, as `synthesis.find_scene` returns it.

    Args:
        path: the file.

    Raises:
        NerfroError: the file is missing, damaged or compressed, or has no refractive body.
    """

    DATA_SET = GltfViews

    def __init__(self, path: Path) -> None:
        with reading(path, "scene ", advice="export it again", missing="give a glTF file as scene=FILE.glb"):
            require_readable(path)
            document = read_document(path)
            loaded: Any = trimesh.load(path, process=False, force="scene", resolver=files_beside(path))
            primitives = primitives_of(document, list(loaded.geometry))
            parts = [_part(primitive, loaded.geometry[primitive.geometry]) for primitive in primitives]
        for line in sorted(_not_modelled(document)):
            print(f"nerfro: {path.name}: {line}")
        self.parts = _nested(_closed(parts, path))

    def build(self, spacing: float) -> SyntheticScene:
        """Return the scene under the sky of the scene `torus`."""
        bodies = [part for part in self.parts if part.ior is not None]
        contents = [part.surface for part in self.parts if part.ior is None]
        glass = join([part.surface for part in bodies])
        centre = 0.5 * (glass.vertices.min(0) + glass.vertices.max(0)).astype(np.float64)
        first = bodies[0]
        assert first.ior is not None
        return SyntheticScene(first.ior, glass, join(contents), torus.sky, aim=centre, parts=tuple(self.parts))


def _without_scale(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    return pose


def _part(primitive: Primitive, geometry: Any) -> Part:
    """Convert the triangles of a node to world units, z axis up, with the normals of the file or flat ones."""
    if not isinstance(geometry, trimesh.Trimesh):
        raise NerfroError(f"{primitive.node} consists of points or lines; remove it from the scene")
    # trimesh computes normals on demand; before the first access, the cache holds only normals from the file.
    has_normals, turn = "vertex_normals" in geometry._cache, np.eye(4)
    normals = geometry.vertex_normals if has_normals else None
    mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, vertex_normals=normals, process=False)
    visual: Any = geometry.visual
    coordinates = getattr(visual, "uv", None)
    # With a material, trimesh keeps the colours as an attribute.
    attributes = getattr(visual, "vertex_attributes", {})
    colours = visual.vertex_colors if visual.kind == "vertex" else attributes.get("color")
    turn[:3, :3] = Z_UP_TO_Y_UP.T
    mesh.apply_transform(turn @ primitive.to_world)
    corners = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    # Without normals, triangles are flat (glTF 2.0, section 3.7.2.1).
    corner_normals = mesh.vertex_normals[mesh.faces] if has_normals else np.repeat(mesh.face_normals[:, None], 3, 1)
    vertices, corner_normals = (np.asarray(a).reshape(-1, 3) for a in (mesh.triangles, corner_normals))
    base = primitive.material.get("pbrMetallicRoughness", {})
    albedo = np.array(base.get("baseColorFactor", [1.0] * 4)[:3])
    texture = getattr(getattr(visual, "material", None), "baseColorTexture", None)
    glass = primitive.glass
    if colours is not None:
        linear = colours[:, :3] / (np.iinfo(colours.dtype).max if colours.dtype.kind == "u" else 1)
        colours = to_srgb(linear[mesh.faces].reshape(-1, 3) * albedo).astype(np.float32)
    if coordinates is not None:  # rows of textures run downwards, and v of trimesh upwards
        coordinates = np.stack([coordinates[:, 0], 1 - coordinates[:, 1]], -1)[mesh.faces].reshape(-1, 2)
    surface = SurfaceMesh(
        vertices.astype(np.float32),
        corners.astype(np.int32),
        corner_normals.astype(np.float32),
        None if glass else colours,
    )
    if glass is not None:
        return Part(primitive.node, surface, glass.ior, glass.absorption)
    pixels = None if texture is None else np.asarray(texture.convert("RGB"), np.float32) / 255
    return Part(primitive.node, surface, albedo=tuple(albedo.tolist()), texture=pixels, texture_coordinates=coordinates)


def _closed(parts: list[Part], path: Path) -> list[Part]:
    """Name the parts as settings are named, turn bodies outwards, and leave open bodies out."""
    kept, names = [], set[str]()
    for part in parts:
        name = re.sub(r"\W+", "_", part.name).strip("_") or "part"
        name = name if name[0].isalpha() else f"part_{name}"
        unique = next(n for n in (name, *(f"{name}_{k}" for k in range(2, len(parts) + 3))) if n not in names)
        names.add(unique)
        if part.ior is not None:
            merged = merge_vertices(part.surface.vertices.astype(np.float64), part.surface.faces)
            if not merged.is_closed:
                print(f"nerfro: {path.name}: {part.name} is refractive but not closed, so it is left out")
                continue
        kept.append(replace(part, name=unique))
    if not any(part.ior is not None for part in kept):
        raise NerfroError(
            f"scene {path} has no closed body with KHR_materials_transmission; in Blender, give a closed object a "
            "material with Transmission Weight 1"
        )
    return kept


def _nested(parts: list[Part]) -> list[Part]:
    """Find the body around each part, outer bodies first; a body that faces inwards within another one is a cavity."""
    bodies = [part for part in parts if part.ior is not None]
    inside = {(a.name, b.name) for a in parts for b in bodies if a is not b and _is_within(a.surface, b.surface)}
    order = {part.name: sum((part.name, body.name) in inside for body in bodies) for part in parts}
    nested: dict[str, Part] = {}
    for part in sorted(parts, key=lambda part: order[part.name]):
        around = [nested[name] for name in nested if (part.name, name) in inside and nested[name].ior is not None]
        outer = around[-1] if around else None
        if part.ior is not None and part.surface.as_trimesh().volume < 0:
            surface = part.surface
            surface = replace(surface, faces=surface.faces[:, ::-1].copy(), normals=-surface.normals)
            part = replace(part, surface=surface)
            if outer is not None:
                part = replace(part, ior=1.0, absorption=(0.0, 0.0, 0.0))
        if outer is not None and outer.ior is not None:
            part = replace(part, outer_ior=outer.ior, outer_absorption=outer.absorption)
        nested[part.name] = part
    return list(nested.values())


def _is_within(surface: SurfaceMesh, body: SurfaceMesh) -> bool:
    """Return whether most points of a surface lie within a closed surface."""
    low, high = body.vertices.min(0), body.vertices.max(0)
    extent = float((high - low).max())
    corners = torch.from_numpy((body.vertices[body.faces] - low) / extent).double()
    points = torch.from_numpy((surface.vertices[:: -(-len(surface.vertices) // 512)] - low) / extent).double()
    along = torch.nn.functional.normalize(torch.tensor([[0.31, 0.53, 0.79]], dtype=torch.float64), dim=-1)
    _, winding = crossings(MeshIntersector(corners), points, along.expand_as(points).contiguous())
    return bool((winding != 0).double().mean() > 0.5)


_MODELLED = {"KHR_materials_transmission", "KHR_materials_ior", "KHR_materials_volume"}


def _not_modelled(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each property of the file that the images do not show."""
    for number, material in enumerate(document.get("materials", [])):
        name = f"material {material.get('name', number)}"
        base, extensions = material.get("pbrMetallicRoughness", {}), material.get("extensions", {})
        share = extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0)
        if share > 0:
            if base.get("roughnessFactor", 1.0) > 0 or "metallicRoughnessTexture" in base:
                yield f"{name}: roughness is not modelled; its surface is smooth"
            if share < 1 or "transmissionTexture" in extensions["KHR_materials_transmission"]:
                yield f"{name}: transmission below 1 is not modelled; it is clear glass"
            if not extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0) > 0:
                yield f"{name}: thin-walled transmission is not modelled; its closed objects are solid"
            if base.get("baseColorFactor", [1.0] * 3)[:3] != [1.0] * 3 or "baseColorTexture" in base:
                yield f"{name}: the colour of the surface is not modelled; set an attenuation colour"
            if extensions.get("KHR_materials_dispersion", {}).get("dispersion", 0) > 0:
                yield f"{name}: dispersion is not modelled; images and scene.json have the index of the d line"
        elif base.get("metallicFactor", 1.0) > 0:
            yield f"{name}: metal is not modelled; it is diffuse"
        if any(material.get("emissiveFactor", [])) or "emissiveTexture" in material:
            yield f"{name}: emission is not modelled"
        if "normalTexture" in material:
            yield f"{name}: the normal map is not modelled"
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            yield f"{name}: alpha is not modelled; it is opaque"
        for extension in sorted(set(extensions) - _MODELLED - {"KHR_materials_dispersion"}):
            yield f"{name}: {extension} is not modelled"
    for key in ("animations", "skins"):
        if document.get(key):
            yield f"{key} are not modelled"
    if document.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights"):
        yield "lights are not modelled; the sky is the only light"
