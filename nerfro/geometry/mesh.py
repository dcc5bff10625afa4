"""Triangle meshes as two arrays, read from any format of trimesh."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nerfro.core.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.reading import reading
from nerfro.geometry.facets import FacetSettings
from nerfro.geometry.gltf import Z_UP_TO_Y_UP, files_beside, is_gltf, primitives_of, read_document, require_readable
from nerfro.geometry.orientation import area_vectors, inward_faces, patches
from nerfro.registry.allowed import Coordinate, check


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles in world units; outward faces are counter-clockwise.

    Attributes:
        vertices: corner positions.
        faces: vertex indices of each triangle.
        normals: unit normals at the corners of the triangles, or zero, if the normals of the file are more accurate
            than the triangles; else None.
        facets: number of the flat facet of each triangle, -1 for triangles of smooth surfaces; None if all are smooth.
            Normals are not smooth across the edges of facets.
        crease_degrees: edges with larger angles between their faces are sharp.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "F 3 3"] | None = None
    facets: Int[np.ndarray, "F"] | None = None
    crease_degrees: float = FacetSettings.crease_degrees

    @property
    def triangles(self) -> Float[np.ndarray, "F 3 3"]:
        return self.vertices[self.faces]

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    def relative_to(self, origin: Float[np.ndarray, "3"]) -> TriangleMesh:
        """Return the mesh in coordinates with another origin."""
        return replace(self, vertices=self.vertices - origin)

    @property
    def is_closed(self) -> bool:
        """Whether every edge belongs to an even number of triangles, so that the inside is defined."""
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        return bool((uses % 2 == 0).all())

    def save(self, path: Path) -> None:
        """Write vertices and triangles as a binary PLY, in double precision for objects far from the origin."""
        header = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(self.vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"element face {len(self.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        faces = np.zeros(len(self.faces), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, self.faces
        write_atomically(path, header.encode() + self.vertices.astype("<f8").tobytes() + faces.tobytes())


def local_origin(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "3"]:
    """Return the origin of the coordinate system for tracing, world units.

    The result is the origin of the world, unless the object is far away from the origin, as in georeferenced data.

    Args:
        points: vertices of the object, or corners of its bounds.
    """
    low, high = points.min(0), points.max(0)
    centre, size = 0.5 * (low + high), float((high - low).max())
    # Rays are in single precision, whose relative spacing of 1.2e-7 turns exit directions by up to 0.01 degrees at a
    # distance of 100 sizes.
    if not 0 < 100 * size < np.abs(centre).max():
        return np.zeros(3)
    return centre.round(num_decimals(size, 1))


def num_decimals(size: float, digits: int) -> int:
    """Return the number of decimals with which lengths of the given size have so many significant digits."""
    return digits - 1 - math.floor(math.log10(size))


def origin_of_file(path: Path) -> Float[np.ndarray, "3"]:
    """Return the `local_origin` of a mesh file; zero for a file without points (`load_mesh` refuses such files)."""
    try:
        points = load_points(path)
    except NerfroError:
        return np.zeros(3)
    return local_origin(points) if len(points) else np.zeros(3)


def load_mesh(path: Path, accept_open_mesh: bool = False) -> TriangleMesh:
    """Read a triangle mesh in any format of trimesh (ply, obj, stl, glb, ...) and merge duplicate vertices.

    glTF files, whose y axis is up, are turned so that the z axis is up.

    Args:
        path: mesh file.
        accept_open_mesh: whether a mesh with holes is accepted.

    Raises:
        NerfroError: the file is missing, unreadable, empty, not finite, or has unaccepted holes.
    """
    turn = Z_UP_TO_Y_UP if is_gltf(path) else np.eye(3)
    missing = "set medium.mesh to a closed triangle mesh (ply, obj, stl, glb)"
    with reading(path, "mesh ", advice="export it as ply, obj, stl or glb", missing=missing):
        loaded = _parse(path)
    vertices = np.asarray(getattr(loaded, "vertices", ()), np.float64)
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64)
    # trimesh computes normals on demand; before the first access, the cache holds only normals from the file.
    read = np.asarray(loaded.vertex_normals, np.float64) if "vertex_normals" in loaded._cache else None
    return make_mesh(vertices, faces, f"mesh {path}", accept_open_mesh, read, turn)


def make_mesh(
    vertices: Float[np.ndarray, "..."],
    faces: Int[np.ndarray, "..."],
    what: str = "the mesh",
    accept_open_mesh: bool = False,
    normals: Float[np.ndarray, "..."] | None = None,
    turn: Float[np.ndarray, "3 3"] | None = None,
) -> TriangleMesh:
    """Check vertices and triangles, merge duplicate vertices, and let all triangles face outwards.

    Args:
        vertices, faces: positions [V, 3] in world units, and vertex indices of triangles [F, 3].
        what: name of the mesh in messages.
        accept_open_mesh: whether a mesh with holes is accepted.
        normals: normals at the vertices, or None.
        turn: rotation of vertices and normals.

    Raises:
        NerfroError: the mesh is empty, not finite, or has unaccepted holes.
    """
    if len(vertices) == 0 or len(faces) == 0:
        raise NerfroError(f"{what} has no triangles; export a surface instead of a point cloud or an empty scene")
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise NerfroError(f"{what} is not made of triangles of points with three coordinates; export it again")
    if not np.isfinite(vertices).all():
        raise NerfroError(f"{what} has vertices that are not finite; export it again")
    turn = np.eye(3) if turn is None else turn
    vertices = vertices @ turn
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise NerfroError(f"{what} has triangles with indices of missing vertices; export it again")
    check(f"{what} reaches too far; scale it to about one unit: ", {"coordinate": Coordinate},
          {"coordinate": float(vertices.flat[np.abs(vertices).argmax()])})  # fmt: skip
    extents = np.ptp(vertices, axis=0)
    # Boxes are stored with seven significant digits.
    if extents.min() <= 1e-4 * extents.max():
        raise NerfroError(
            f"{what} is {extents.min():g} world units thin and {extents.max():g} long, so it has no inside; "
            "export a solid"
        )
    if normals is not None and normals.shape != vertices.shape:
        raise NerfroError(f"{what} has normals of shape {list(normals.shape)} for its vertices; export it again")
    if normals is not None:
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros(normals.shape), where=np.isfinite(length) & (length > 0))
        normals = (normals @ turn)[faces]
    mesh = _facing_outwards(merge_vertices(vertices, faces, normals))
    if not accept_open_mesh and not mesh.is_closed:
        raise NerfroError(
            f"{what} is not watertight, so its inside is not defined; close its holes, "
            "or set medium.accept_open_mesh=true to decide by majority along the three axes"
        )
    return mesh


def _facing_outwards(mesh: TriangleMesh) -> TriangleMesh:
    """Reverse triangles and normals on the inside, and drop normals without information."""
    if not len(mesh.faces):
        return mesh
    inwards = inward_faces(mesh.vertices, mesh.faces)[:, None]
    faces, normals = np.where(inwards, mesh.faces[:, ::-1], mesh.faces), mesh.normals
    if normals is not None:
        normals = np.where(inwards[..., None], normals[:, ::-1], normals)
        outward = np.einsum("fcx,fx->fc", normals, area_vectors(mesh.vertices[faces])) >= 0
        normals = np.where(outward[..., None], normals, -normals)
        informative = informative_normals(mesh.vertices, faces, normals)
        normals = normals * informative[:, None, None] if informative.any() else None
    return TriangleMesh(mesh.vertices, faces, normals)


def load_points(path: Path) -> Float[np.ndarray, "points 3"]:
    """Read the points of a point cloud, or the vertices of a mesh, in any format of trimesh.

    Raises:
        NerfroError: the file cannot be read.
    """
    with reading(path, trouble="has no readable points", advice="export it again, or remove it"):
        points = np.asarray(_parse(path).vertices, np.float64).reshape(-1, 3)
    return points @ Z_UP_TO_Y_UP if is_gltf(path) else points


def _parse(path: Path) -> Any:
    """Read a file with trimesh; scenes of several bodies become one mesh.

    Of glTF files with refractive materials, only the objects of these materials are read.
    """
    import trimesh

    if is_gltf(path):
        require_readable(path)
    loaded: Any = trimesh.load(path, process=False, resolver=files_beside(path) if is_gltf(path) else None)
    if not isinstance(loaded, trimesh.Scene):
        return loaded
    if is_gltf(path):
        primitives = primitives_of(read_document(path), list(loaded.geometry))
        glass = {primitive.geometry for primitive in primitives if primitive.glass is not None}
        loaded.delete_geometry([name for name in loaded.geometry if glass and name not in glass])
    return loaded.to_mesh()


def merge_vertices(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "F 3 3"] | None = None,
) -> TriangleMesh:
    """Merge vertices at equal positions, and remove degenerate and duplicate triangles.

    Texture seams and STL files repeat vertices. A triangle and a duplicate of the same orientation would cancel,
    because inside and outside are decided by parity.
    """
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    merged = inverse.reshape(-1)[faces]
    kept = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    # Rotated so that the smallest index comes first, which keeps the orientation of a triangle.
    rotated = np.take_along_axis(merged, (merged.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    first = np.zeros(len(merged), bool)
    first[np.unique(rotated, axis=0, return_index=True)[1]] = True
    kept &= first
    return TriangleMesh(unique, merged[kept], None if normals is None else normals[kept])


def subdivided(mesh: TriangleMesh, max_edge: float) -> TriangleMesh:
    """Bisect edges until none is longer than `max_edge`; the shape stays, and a closed mesh stays closed.

    Args:
        mesh: the mesh.
        max_edge: largest length of an edge, world units.

    Returns:
        A mesh without normals and facets; the given one if it has no longer edges.
    """
    while np.linalg.norm(mesh.triangles - np.roll(mesh.triangles, -1, 1), axis=-1).max() > max_edge:
        vertices, faces = mesh.vertices, mesh.faces
        sides = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
        edges, side = np.unique(sides, axis=0, return_inverse=True)
        is_long = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > max_edge
        middle, side = len(vertices) + np.cumsum(is_long) - 1, side.reshape(faces.shape)
        # A short side has its start in place of its middle, and triangles without area are left out.
        (a, b, c), (ab, bc, ca) = faces.T, np.where(is_long[side], middle[side], faces).T
        parts = np.concatenate(
            [np.stack(corners, 1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        has_area = (parts != np.roll(parts, 1, 1)).all(1)
        mesh = TriangleMesh(np.concatenate([vertices, vertices[edges[is_long]].mean(1)]), parts[has_area])
    return mesh


def require_inside(any_inside: bool) -> None:
    """Raise an error if no vertex of a grid lies inside a mesh, because there would be no object."""
    if not any_inside:
        raise NerfroError(
            "no vertex of the grid lies inside the mesh: it is flat, thinner than a voxel (raise medium.resolution), "
            "or every triangle has a duplicate of opposite orientation"
        )


_MIN_COSINE = np.cos(np.radians(30.0))  # between the normals of a corner and of its triangle


def informative_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]
) -> Bool[np.ndarray, "F"]:
    """Find the triangles whose normals in the file say more about the surface than the triangles do.

    Programs often write averages of the normals of the adjacent triangles, or copies of the normals of the triangles.
    Averages tilt on flat faces beside rounded edges. The criterion is the residual of a smooth surface through two
    vertices: along an edge from x_i to x_j, the normals N_i and N_j of the surface satisfy

        (N_i + N_j) . (x_j - x_i) = 0

    up to terms of third order in the length of the edge, and exactly on planes, spheres, cylinders and cones. The
    normals of a patch (see `patches`) are informative if their root mean square residual is below the residuals of
    averages with common weights. Averages are taken over the corners at a vertex that have the same normal in the file,
    so that sharp edges of the file stay sharp.

    Args:
        vertices: world units; equal positions must be merged.
        faces: vertex indices of each triangle, outward faces counter-clockwise.
        normals: unit normals of the file at the corners, or zero.
    """
    triangles = vertices[faces]
    forward, backward = np.roll(triangles, -1, 1) - triangles, np.roll(triangles, 1, 1) - triangles
    areas = area_vectors(triangles)
    size = np.linalg.norm(areas, axis=1)
    flat = (areas / np.where(size > 0, size, 1.0)[:, None])[:, None]
    angle = np.arctan2(size[:, None], (forward * backward).sum(-1))
    area = np.broadcast_to(size[:, None], angle.shape)
    corner = _numbered(faces, normals)
    facet = _numbered(corner, np.broadcast_to(flat, normals.shape))
    num_coplanar = np.bincount(facet.reshape(-1))[facet]
    trusted = (normals * flat).sum(-1) >= _MIN_COSINE
    patch = np.unique(patches(faces)[0], return_inverse=True)[1]

    def residual(candidate: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, " corners"]:
        length = np.linalg.norm(forward, axis=-1)
        sums = ((candidate + np.roll(candidate, -1, 1)) * forward).sum(-1)
        cosine = np.divide(
            sums, length, out=np.zeros(length.shape), where=trusted & np.roll(trusted, -1, 1) & (length > 0)
        )
        return np.bincount(patch, (cosine**2).sum(1))

    def average(weight: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3 3"]:
        terms = (weight[..., None] * flat).reshape(-1, 3)
        sums = np.stack([np.bincount(corner.reshape(-1), column) for column in terms.T], -1)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        return (sums / np.where(length > 0, length, 1.0))[corner]

    # The second weight counts the triangles of one flat polygon once.
    weights = (np.ones(angle.shape), 1 / num_coplanar, angle, area, area * angle)
    best = np.min([residual(average(weight)) for weight in weights], axis=0)
    return (residual(normals) < 0.98**2 * best)[patch]


def _numbered(index: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]) -> Int[np.ndarray, "F 3"]:
    """Number the different pairs of an index and a rounded normal."""
    # Products with an odd number that wrap around scatter the keys evenly; sorting rows would take much longer.
    key = index.astype(np.int64)
    for axis in range(3):
        # Normals at one vertex that agree to 1e-5 are one normal.
        key = key * 6364136223846793005 + np.rint(normals[..., axis] * 1e5).astype(np.int64)
    return np.unique(key, return_inverse=True)[1].reshape(index.shape)
