"""Rendering of a scene with Mitsuba 3: images by path tracing, and silhouettes of the glass."""

from __future__ import annotations

import functools
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from nerfro.core.errors import NerfroError, optional
from nerfro.core.light import to_linear
from nerfro.files.lat_long import envmap_texture
from nerfro.synthetic import llvm
from nerfro.synthetic.glass import EMBEDDED, PLUGIN, register_materials
from nerfro.synthetic.scene import Panel, Part, SurfaceMesh, SyntheticScene

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb", "scalar_rgb")
# Hammersley points: at most one point lies in each row and column, which edges may be parallel to.
SILHOUETTE_PLACES = [((k + 0.5) / 128, (int(f"{k:07b}"[::-1], 2) + 0.5) / 128) for k in range(128)]
SAMPLES_PER_PASS = 6_000_000  # a wavefront of paths takes about 1 GB of memory per 10 million paths
ROULETTE_DEPTH, MAX_DEPTH = 32, 1024  # large, because cubes reflect light many times inside


@functools.cache
def load_mitsuba(variant: str = "auto") -> ModuleType:
    """Import Mitsuba, activate one of its variants, and register nerfro's materials for it.

    Args:
        variant: one of `VARIANTS`, or "auto" for the first that works on this machine. "auto" prints one line if only
            the scalar variant works, which is about seventy times slower.

    Raises:
        NerfroError: Mitsuba is not installed, or the variant does not work on this machine.
    """
    if variant not in ("auto", *VARIANTS):
        raise NerfroError(f"unknown Mitsuba variant '{variant}'; choose auto, {', '.join(VARIANTS)}")
    llvm.select_llvm()
    drjit, mitsuba = (optional(name, "synthesize", llvm.PURPOSE) for name in ("drjit", "mitsuba"))
    selected, reason = variant, llvm.missing_llvm()
    if variant == "auto":
        cuda = drjit.has_backend(drjit.JitBackend.CUDA)
        selected = "llvm_ad_rgb" if reason is None else "cuda_ad_rgb" if cuda else "scalar_rgb"
        if selected == "scalar_rgb":
            print(f"nerfro: Mitsuba runs about seventy times slower, because {reason}; {llvm.HINT}", file=sys.stderr)
    elif variant == "llvm_ad_rgb" and reason is not None:
        raise NerfroError(f"variant=llvm_ad_rgb cannot run, because {reason}; {llvm.HINT}, or choose variant=auto")
    elif variant == "cuda_ad_rgb" and not drjit.has_backend(drjit.JitBackend.CUDA):
        raise NerfroError("variant=cuda_ad_rgb cannot run, because Dr.Jit finds no CUDA driver; choose variant=auto")
    mitsuba.set_variant(selected)
    register_materials(selected)
    return mitsuba


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion, square pixels; pixel (row i, column j) covers the square (j, i) to (j + 1, i + 1).

    Attributes:
        width, height: resolution, pixels.
        focal: focal length, pixels.
        cx, cy: principal point, pixels from the left and upper edge of the image.
    """

    width: int
    height: int
    focal: float
    cx: float
    cy: float

    @classmethod
    def square(cls, angle_x: float, size: int) -> Pinhole:
        """Make a camera of square images with a field of view of `angle_x` radians."""
        return cls(size, size, 0.5 * size / np.tan(0.5 * angle_x), 0.5 * size, 0.5 * size)

    @property
    def angle_x(self) -> float:
        """Horizontal field of view of a camera with the principal point in the centre of the image, radians."""
        return float(2 * np.arctan(0.5 * self.width / self.focal))


class PathTracer:
    """Renders one scene from many cameras.

    Args:
        scene: scene to render.
        fresnel: False for transmission and total reflection only (the paper's image formation), True for a physical
            dielectric with partial reflection.
        camera: camera of all images.
        variant: Mitsuba variant, see `load_mitsuba`.
    """

    def __init__(self, scene: SyntheticScene, fresnel: bool, camera: Pinhole, variant: str = "auto") -> None:
        self.mitsuba = mi = load_mitsuba(variant)
        self.camera = camera
        surroundings = {f"panel_{number}": panel_shape(mi, panel) for number, panel in enumerate(scene.panels)}
        if scene.sky is not None:
            # Two texels per pixel of the background.
            height = int(np.clip(2 * np.pi / camera.angle_x * camera.width, 256, 2048))
            # The y axis is up in an environment map of Mitsuba, and the z axis in nerfro.
            upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
            texture = mi.Bitmap(envmap_texture(scene.sky, height, np.asarray(upright.matrix)[:3, :3]))
            surroundings["sky"] = {"type": "envmap", "bitmap": texture, "to_world": upright}
            self._sky_frame = np.asarray(upright.matrix)
        glass, content = _part_shapes(mi, scene, fresnel) if scene.parts else _shapes(mi, scene, fresnel)
        self.glass = mi.load_dict({"type": "scene", **glass})
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH},
                **surroundings,
                **glass,
                **content,
            }
        )

    def turn_sky(self, rotation: np.ndarray) -> None:
        """Rotate the sky; a rotation of sky and camera about an object is the opposite rotation of the object."""
        frame = self._sky_frame.copy()
        frame[:3, :3] = rotation @ frame[:3, :3]
        parameters = self.mitsuba.traverse(self.scene)
        parameters["sky.to_world"] = self.mitsuba.Transform4f(frame.tolist())
        parameters.update()

    def render(self, pose: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Return linear radiance [H, W, 3], averaged over each pixel with a box filter.

        Args:
            pose: camera-to-world matrix [4, 4], OpenGL axes.
            spp: samples per pixel; rendered in passes of at most `SAMPLES_PER_PASS` samples.
            seed: seed of the sampler; equal seeds give equal images.
        """
        camera = self.camera
        sensor = {
            "type": "perspective",
            "fov": float(np.degrees(camera.angle_x)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - camera.cx / camera.width,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height,
            "near_clip": 0.01,
            "far_clip": 100.0,
        }
        return self.render_sensor(sensor, pose, spp, seed)

    def render_sensor(self, sensor: dict, pose: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Render with a sensor of Mitsuba, given as a dictionary without pose and film; see `render`."""
        mi, camera = self.mitsuba, self.camera
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film |= {"pixel_format": "rgb", "component_format": "float32"}
        # Mitsuba's cameras look along +z with x to the left, and nerfro's cameras along -z with x to the right.
        to_world = mi.ScalarTransform4f((pose @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist())
        loaded = mi.load_dict({**sensor, "to_world": to_world, "film": film, "sampler": {"type": "independent"}})
        per_pass = max(1, min(spp, SAMPLES_PER_PASS // (camera.width * camera.height)))
        total = np.zeros((camera.height, camera.width, 3))
        for number, first in enumerate(range(0, spp, per_pass)):
            count = min(per_pass, spp - first)
            # Mitsuba hashes the seed, so neighbouring seeds are independent; 4096 passes are 24 G samples per view.
            image = mi.render(self.scene, sensor=loaded, spp=count, seed=(seed * 4096 + number) % 2**32)
            total += count * np.asarray(image, np.float64)
        return total / spp

    def silhouette(self, pose: np.ndarray) -> np.ndarray:
        """Return the fraction [H, W] of each pixel that the unoccluded glass covers, to about 1 / 128."""
        mi, camera = self.mitsuba, self.camera
        total = np.zeros((camera.height, camera.width))
        for x, y in SILHOUETTE_PLACES:
            u, v = np.meshgrid(np.arange(camera.width) + x - camera.cx, camera.cy - np.arange(camera.height) - y)
            directions = np.stack([u, v, np.full_like(u, -camera.focal)], -1).reshape(-1, 3) @ pose[:3, :3].T
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            if mi.variant().startswith("scalar"):
                hits = [self.glass.ray_test(mi.Ray3f(list(pose[:3, 3]), list(direction))) for direction in directions]
            else:
                origins = mi.Point3f(*(mi.Float(np.full(len(directions), x, np.float32)) for x in pose[:3, 3]))
                rays = mi.Ray3f(origins, mi.Vector3f(*(mi.Float(x.astype(np.float32)) for x in directions.T)))
                hits = self.glass.ray_test(rays)
            total += np.asarray(hits, bool).reshape(total.shape)
        return total / len(SILHOUETTE_PLACES)


def panel_shape(mi: ModuleType, panel: Panel) -> dict:
    """Return a Mitsuba rectangle with the image of the panel, decoded to linear, as radiance or albedo."""
    linear = {
        "type": "bitmap",
        # In Mitsuba, v and the rows of pixels run upwards along a rectangle.
        "bitmap": mi.Bitmap(np.ascontiguousarray(to_linear(panel.image[::-1]), np.float32)),
        "raw": True,
        "filter_type": "bilinear" if panel.smooth else "nearest",
        "wrap_mode": "clamp",
    }
    shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f(panel.to_world.tolist())}
    if panel.glows:
        # A black mirror and not a black diffuser, for which the integrator would trace useless shadow rays.
        black = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": 0.0}}
        return shape | {"bsdf": black, "light": {"type": "area", "radiance": linear}}
    return shape | {"bsdf": {"type": "diffuse", "reflectance": linear}}


def _shapes(mi: ModuleType, scene: SyntheticScene, fresnel: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the shapes of the glass and of the interior with their materials."""
    absorption = {"absorption": mi.ScalarColor3f(*scene.absorption)}
    glass: dict = {"type": PLUGIN, "int_ior": scene.ior, "tint": mi.ScalarColor3f(*scene.tint), "fresnel": fresnel}
    glass |= absorption
    absorbs = any(scene.absorption)
    if fresnel and not absorbs:
        tint = {"type": "rgb", "value": list(scene.tint)}
        glass = {"type": "dielectric", "int_ior": scene.ior, "ext_ior": 1.0, "specular_transmittance": tint}
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    if absorbs:
        paint = {"type": EMBEDDED, "nested": paint, **absorption}
    glass_shape = triangle_shape(mi, "glass", scene.glass, glass)
    return {"glass": glass_shape}, {"interior": triangle_shape(mi, "interior", scene.interior, paint)}


def _part_shapes(mi: ModuleType, scene: SyntheticScene, fresnel: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the shapes of the bodies and of the contents of a scene with parts."""
    bodies, contents = {}, {}
    for number, part in enumerate(scene.parts):
        outer = mi.ScalarColor3f(*part.outer_absorption)
        if part.ior is not None:
            glass = {"type": PLUGIN, "int_ior": part.ior, "ext_ior": part.outer_ior, "fresnel": fresnel}
            glass |= {"absorption": mi.ScalarColor3f(*part.absorption), "outer_absorption": outer}
            bodies[f"body_{number}"] = triangle_shape(mi, part.name, part.surface, glass)
            continue
        paint: dict[str, Any] = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": _albedo(mi, part)}}
        if any(part.outer_absorption):
            paint = {"type": EMBEDDED, "nested": paint, "absorption": outer}
        shape = triangle_shape(mi, part.name, part.surface, paint, part.texture_coordinates)
        contents[f"content_{number}"] = shape
    return bodies, contents


def _albedo(mi: ModuleType, part: Part) -> dict[str, Any]:
    if part.surface.colours is not None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    if part.texture is None or part.texture_coordinates is None:
        return {"type": "rgb", "value": list(part.albedo)}
    linear = to_linear(part.texture) * np.asarray(part.albedo)
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(linear, np.float32)), "raw": True}


def triangle_shape(
    mi: ModuleType, name: str, surface: SurfaceMesh, material: dict, texture_coordinates: np.ndarray | None = None
):
    """Return a Mitsuba mesh; vertex colours become the attribute `vertex_color`, decoded to linear albedo."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material)
    size, has_texture = (len(surface.vertices), len(surface.faces)), texture_coordinates is not None
    mesh = mi.Mesh(name, *size, has_vertex_normals=True, has_vertex_texcoords=has_texture, props=properties)
    if surface.colours is not None:
        mesh.add_attribute("vertex_color", 3, to_linear(surface.colours).astype(np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = surface.vertices.ravel()
    if texture_coordinates is not None:
        parameters["vertex_texcoords"] = texture_coordinates.astype(np.float32).ravel()
    parameters["faces"] = surface.faces.astype(np.uint32).ravel()
    parameters.update()
    # Normals come last, because some versions of Mitsuba replace normals by averages over facets when positions change.
    parameters["vertex_normals"] = surface.normals.ravel()
    parameters.update()
    return mesh
