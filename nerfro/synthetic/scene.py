"""Description of a scene: a glass body, coloured objects inside, and the surroundings.

Surfaces are triangles with exact normals. `rounded_box`, `sphere` and `torus_angles` mesh shapes without a distance
field, and `lat_long_texture` draws the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from nerfro.files import lat_long
from nerfro.files.atomic import write_atomically


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle surface in world units; normals point out of the enclosed volume.

    Attributes:
        vertices: float32 [V, 3].
        faces: int32 [F, 3], counter-clockwise seen from outside.
        normals: float32 [V, 3], unit normals of the underlying smooth surface, not averages over facets.
        colours: float32 [V, 3] sRGB albedo in [0, 1], or None for glass.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray | None = None

    def as_trimesh(self) -> trimesh.Trimesh:
        """Return a trimesh with the same vertices in the same order."""
        colours = None if self.colours is None else np.rint(self.colours * 255).astype(np.uint8)
        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=colours, process=False
        )

    def save(self, path: Path) -> None:
        """Write a binary PLY with normals and, if present, sRGB vertex colours."""
        write_atomically(path, trimesh.exchange.ply.export_ply(self.as_trimesh(), vertex_normal=True))


def join(surfaces: Sequence[SurfaceMesh]) -> SurfaceMesh:
    """Join surfaces to one surface, without colours unless all have some; no surfaces give an empty one."""
    if not surfaces:
        return SurfaceMesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty((0, 3), np.float32))
    offsets = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    colours = [surface.colours for surface in surfaces if surface.colours is not None]
    return SurfaceMesh(
        vertices=np.concatenate([surface.vertices for surface in surfaces]),
        faces=np.concatenate([surface.faces + offset for surface, offset in zip(surfaces, offsets, strict=True)]),
        normals=np.concatenate([surface.normals for surface in surfaces]),
        colours=np.concatenate(colours) if len(colours) == len(surfaces) else None,
    )


def rounded_box(half_sides: Sequence[float] | np.ndarray, radius: float, edge_steps: int) -> SurfaceMesh:
    """Mesh a box around the origin whose edges and corners are rounded with `radius`, watertight.

    The surface is the set of points at distance `radius` from the inner box of half sides `half_sides - radius`. Flat
    faces consist of two triangles each; edges are divided into `edge_steps` equal angles per 45 degrees.
    """
    outer = np.asarray(half_sides, np.float64)
    inner = outer - radius
    rise = radius * np.tan(np.linspace(0, np.pi / 4, edge_steps + 1))
    points, quads, count = [], [], 0
    for axis in range(3):
        u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
        u, v = (np.concatenate([-(inner[a] + rise)[::-1], inner[a] + rise]) for a in (u_axis, v_axis))
        columns, rows = len(u), len(v)
        index = np.arange(columns * rows).reshape(columns, rows)
        corners = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
        for sign in (1, -1):
            face = np.empty((columns, rows, 3))
            face[..., axis] = sign * outer[axis]
            face[..., u_axis], face[..., v_axis] = u[:, None], v[None]
            points.append(face.reshape(-1, 3))
            quads.append((corners if sign > 0 else corners[:, ::-1]) + count)
            count += columns * rows
    cube = np.concatenate(points)
    core = np.clip(cube, -inner, inner)
    normals = cube - core
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Merge the vertices of common edges, which neighbouring faces repeat, because the mesh must be watertight.
    _, first, inverse = np.unique(np.round(cube, 9), axis=0, return_index=True, return_inverse=True)
    quad = inverse.reshape(-1)[np.concatenate(quads)]
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    vertices = (core + radius * normals)[first]
    return SurfaceMesh(vertices.astype(np.float32), faces.astype(np.int32), normals[first].astype(np.float32))


def sphere(radius: float, subdivisions: int) -> SurfaceMesh:
    """Mesh a sphere around the origin as a subdivided icosahedron (20 * 4^subdivisions faces) with exact normals."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return SurfaceMesh(
        (normals * radius).astype(np.float32), np.asarray(mesh.faces, np.int32), normals.astype(np.float32)
    )


def torus_angles(major_radius: float, minor_radius: float, spacing: float) -> tuple[SurfaceMesh, np.ndarray]:
    """Mesh a torus around the z axis with vertices every `spacing`, and return the angles of the vertices.

    Angles [V, 2] in [0, 2 pi) run around the axis, and around the tube; the centre line of the tube has `major_radius`.
    """
    around = int(np.ceil(2 * np.pi * (major_radius + minor_radius) / spacing))
    across = int(np.ceil(2 * np.pi * minor_radius / spacing))
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    phi, theta = 2 * np.pi * i.ravel() / around, 2 * np.pi * j.ravel() / across
    outward = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], -1)
    normals = np.cos(theta)[:, None] * outward + np.sin(theta)[:, None] * np.array([0.0, 0.0, 1.0])
    vertices = major_radius * outward + minor_radius * normals

    def index(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return ((a % around) * across + b % across).ravel()

    a, b, c, d = index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    surface = SurfaceMesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))
    return surface, np.stack([phi, theta], -1)


Sky = Callable[[np.ndarray], np.ndarray]
"""Maps unit directions [..., 3], z up, to linear radiance [..., 3] of at most 1, so that 8-bit images never clip."""


def lat_long_texture(sky: Sky, height: int, supersampling: int = 2) -> np.ndarray:
    """Return the sky as a float32 lat-long image [H, 2H, 3] of linear radiance, averaged over each pixel."""
    k = supersampling
    texture = np.empty((height, 2 * height, 3), np.float32)
    fine = lat_long.directions(k * height).numpy()
    for row in range(height):  # by rows, because the intermediate arrays of a 4k sky exceed the memory
        band = sky(fine[k * row : k * (row + 1)])
        texture[row] = band.reshape(k, 2 * height, k, 3).mean((0, 2))
    return texture


Vector = Sequence[float] | np.ndarray
"""Three numbers along x, y, z."""


@dataclass(frozen=True)
class Panel:
    """A rectangle with an image on the front; the back is black.

    Attributes:
        corner: upper left corner [3], world units.
        right: upper edge [3], from left to right.
        down: left edge [3], from top to bottom.
        image: sRGB in [0, 1], float32 [H, W, 3].
        glows: whether the image is emitted radiance, equal in all directions, instead of albedo.
        smooth: whether the image is interpolated between pixels.
    """

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    image: np.ndarray
    glows: bool = False
    smooth: bool = True

    @property
    def to_world(self) -> np.ndarray:
        """Matrix [4, 4] from the square [-1, 1]^2 of x (right) and y (up) to the world; z points to the front."""
        matrix = np.eye(4)
        out = np.cross(self.down, self.right)
        columns = [0.5 * self.right, -0.5 * self.down, out / np.linalg.norm(out)]
        matrix[:3] = np.stack([*columns, self.corner + 0.5 * (self.right + self.down)], -1)
        return matrix


@dataclass(frozen=True)
class Part:
    """A surface with a material of its own: a refractive body, or diffuse content.

    Attributes:
        name: name in messages and files.
        surface: triangles with normals; vertex colours, if there are any, are factors of the albedo.
        ior: refractive index of a body; None for content.
        absorption: absorption of a body for each colour channel, per world unit.
        outer_ior: refractive index around a body.
        outer_absorption: absorption around the surface, per world unit.
        albedo: linear albedo of content.
        texture: further factor of the albedo, sRGB in [0, 1], float32 [H, W, 3], or None.
        texture_coordinates: float32 [V, 2] from the upper left corner of the texture, or None.
    """

    name: str
    surface: SurfaceMesh
    ior: float | None = None
    absorption: Vector = (0.0, 0.0, 0.0)
    outer_ior: float = 1.0
    outer_absorption: Vector = (0.0, 0.0, 0.0)
    albedo: Vector = (1.0, 1.0, 1.0)
    texture: np.ndarray | None = None
    texture_coordinates: np.ndarray | None = None


@dataclass(frozen=True)
class SyntheticScene:
    """A refractive object in world units, z up.

    Attributes:
        ior: refractive index of the glass; the index of the surroundings is 1.
        glass: closed outer surface of the glass.
        interior: coloured diffuse surfaces inside the glass, without contact to the outer surface.
        sky: linear radiance in [0, 1] from every direction, or None where panels close the scene.
        panels: flat surfaces at finite distance around the object.
        tint: linear factor per colour channel on each crossing of the glass surface, as in the paper's image formation,
            where paths are not absorbed.
        absorption: absorption of the glass for each colour channel, per world unit (Beer-Lambert).
        aim: point in the centre of the images.
        parts: bodies and contents with materials of their own, which are rendered in place of glass and interior.
    """

    ior: float
    glass: SurfaceMesh
    interior: SurfaceMesh
    sky: Sky | None
    panels: tuple[Panel, ...] = ()
    tint: Vector = (1.0, 1.0, 1.0)
    absorption: Vector = (0.0, 0.0, 0.0)
    aim: Vector = (0.0, 0.0, 0.0)
    parts: tuple[Part, ...] = ()

    def with_glass(self, ior: float | None, absorption: Vector) -> SyntheticScene:
        """Return the scene with another index, unless it is None, and another absorption of the glass.

        An absorption of zero leaves that of parts unchanged.
        """
        parts = self.parts
        if ior is not None:
            parts = tuple(replace(part, ior=ior) if part.ior is not None else part for part in parts)
        if any(absorption):
            parts = tuple(replace(part, absorption=absorption) if part.ior is not None else part for part in parts)
        return replace(self, ior=self.ior if ior is None else ior, absorption=absorption, parts=parts)
