"""Closed surfaces of meshes: connected surfaces, checks for crossings, and the thickness of walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import area_vectors

_MARGIN = 1e-3  # fraction of an edge; surfaces that touch at the ends of an edge do not cross
_TOUCHING = 1e-5  # fraction of the mesh's extent; points closer to a surface along a line lie on the surface


def bodies_of(mesh: TriangleMesh) -> Int[np.ndarray, "F"]:
    """Return the number of the connected surface of each triangle."""
    from trimesh.graph import connected_component_labels

    body = connected_component_labels(mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices))
    return np.unique(body[mesh.faces[:, 0]], return_inverse=True)[1].reshape(-1)


def require_separate(mesh: TriangleMesh) -> None:
    """Raise an error if closed surfaces of a mesh cross or coincide; nested surfaces are allowed.

    A point inside two crossing surfaces would count as outside, because inside and outside are decided by parity.
    """
    body = bodies_of(mesh)
    # Scaled to extent one around the origin, because Embree computes in single precision.
    triangles = (mesh.triangles - mesh.bounds.mean(0)) / np.ptp(mesh.bounds, axis=0).max()
    corners = [triangles[body == number] for number in range(body.max() + 1)]
    low, high = (np.stack([end(c.reshape(-1, 3), axis=0) for c in corners]) for end in (np.min, np.max))
    for number, own in enumerate(corners):
        near = (low <= high[number] + _TOUCHING).all(1) & (high >= low[number] - _TOUCHING).all(1)
        near[number] = False
        if not near.any():
            continue
        others = MeshIntersector(np.concatenate([corners[other] for other in near.nonzero()[0]]))
        if _are_crossed(others, own) or not _is_on_one_side(others, own):
            raise NerfroError(
                "closed surfaces of the mesh cross, so their inside is not defined; unite them (boolean union), "
                "or give each body inside another in bodies={NAME: {mesh: FILE, ior: 1.33}}"
            )


def require_simple(mesh: TriangleMesh) -> None:
    """Raise an error if a closed surface crosses itself.

    A part that is inside twice would act as a cavity, and has a winding number of 2 or more. A part that sticks out
    with the inside turned outwards has -1. Points on both sides of the surface are tested, because the front of a
    surface that crosses itself may be inside. Without Embree, nothing is checked.

    Args:
        mesh: world units; the outer surface faces outwards, and the surface of a cavity faces the cavity.
    """
    points, inwards = points_below(mesh, 4096)  # on the surface, at which winding numbers are computed
    extent = np.ptp(mesh.bounds, axis=0).max()
    try:
        triangles = MeshIntersector((mesh.triangles - mesh.bounds.mean(0)) / extent)
    except NerfroError:  # without Embree
        return
    points = (points - torch.from_numpy(mesh.bounds.mean(0))) / extent
    sides = (points, points - 6 * _TOUCHING * inwards)
    # Where faces of two bodies coincide, Embree finds one of them; the line in the other direction avoids them.
    lines = [[crossings(triangles, side, sign * inwards)[1] for sign in (1, -1)] for side in sides]
    windings = torch.stack([torch.stack(line) for line in lines])
    total = windings.sum()
    if total.abs() < len(points):  # a surface without an interior is refused elsewhere
        return
    windings = windings * total.sign()  # the front of most of the surface may be inside
    share = ((windings < 0) | (windings > 1)).all(1).any(0).double().mean().item()
    if share > 0.002:  # folds of a scan are accepted
        raise NerfroError(
            f"the surface of the mesh crosses itself: {share:.1%} of the surface bounds a part that is inside twice, "
            "which would act as a cavity, or inside out; unite the parts (boolean union, or voxel remesh in Blender), "
            "or give the parts as bodies={NAME: {mesh: FILE, ior: 1.5}, ...}"
        )


def points_below(mesh: TriangleMesh, count: int) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points 3"]]:
    """Return random points just below a closed surface, uniform in area, and unit vectors inwards."""
    triangles, normals = mesh.triangles, area_vectors(mesh.triangles)
    size = np.linalg.norm(normals, axis=1)
    generator = np.random.default_rng(0)
    face = generator.choice(len(size), count, p=size / size.sum())
    weights = generator.dirichlet(np.ones(3), count)
    inwards = -normals[face] / size[face, None]
    below = (weights[..., None] * triangles[face]).sum(1) + 3 * _TOUCHING * np.ptp(mesh.bounds, 0).max() * inwards
    return torch.from_numpy(below), torch.from_numpy(inwards)


def _are_crossed(others: MeshIntersector, own: Float[np.ndarray, "F 3 3"]) -> bool:
    """Return whether an edge of a surface crosses a triangle; the test finds crossings of any thickness."""
    start, end = (torch.from_numpy(own[:, corners].reshape(-1, 3)) for corners in ([0, 1, 2], [1, 2, 0]))
    along = end - start
    hit = others.first_hits(start, along)
    start, along, hit = start[hit >= 0], along[hit >= 0], hit[hit >= 0]
    normal, share = others.areas(hit), others.distance(start, along, hit)
    # Edges in the plane of a triangle, and edges that touch the border of a triangle, do not cross the triangle.
    through = (along * normal).sum(-1).abs() > _MARGIN * along.norm(dim=-1) * normal.norm(dim=-1)
    to_corners = others.corners[hit] - (start + share[:, None] * along)[:, None]
    parts = (torch.linalg.cross(to_corners, to_corners.roll(-1, 1)) * normal[:, None]).sum(-1)
    within = (parts > _MARGIN * parts.sum(-1, keepdim=True)).all(-1)
    return bool((through & within & (share > _MARGIN) & (share < 1 - _MARGIN)).any())


def _is_on_one_side(others: MeshIntersector, own: Float[np.ndarray, "F 3 3"]) -> bool:
    """Return whether all points of a surface lie inside, or all outside; finds crossings where only edges meet.

    A surface without points clear of the others coincides with the others and has no side.
    """
    generator = np.random.default_rng(0)
    # Between 512 and 65,536 points of a body are tested, on three lines through each point.
    some = own[:: -(-len(own) // 2**16)]
    weights = generator.dirichlet(np.ones(3), (-(-512 // len(some)), len(some)))
    points = torch.from_numpy(np.einsum("nfc,fcx->nfx", weights, some).reshape(-1, 3))
    lines = torch.nn.functional.normalize(torch.from_numpy(generator.normal(size=(3, 3))), dim=-1)
    # For points on a surface, the parities of the two directions differ.
    met = [crossings(others, points, (sign * line).expand_as(points))[0] for line in lines for sign in (1, -1)]
    odd = torch.stack(met) % 2 == 1
    return bool(odd.all(0).any() != (~odd).all(0).any())


def crossings(
    triangles: MeshIntersector, points: Float[Tensor, "points 3"], along: Float[Tensor, "points 3"]
) -> tuple[Int[Tensor, " points"], Int[Tensor, " points"]]:
    """Return how many triangles the line from each point crosses, and the winding number at the point."""
    count, winding = torch.zeros(2, len(points), dtype=torch.long)
    left, origin = torch.arange(len(points)), points + _TOUCHING * along
    while len(left):
        hit = triangles.first_hits(origin, along[left])
        left, origin, hit = left[hit >= 0], origin[hit >= 0], hit[hit >= 0]
        count[left] += 1
        winding[left] += (triangles.areas(hit) * along[left]).sum(-1).sign().long()
        distance = triangles.distance(origin, along[left], hit)
        origin = origin + (distance.clamp(min=0) + _TOUCHING)[:, None] * along[left]
    return count, winding


@dataclass(frozen=True)
class WallSettings(AlgorithmSettings):
    """Settings of the resolution at which a grid describes thin walls.

    The median error of exit directions behind a hollow ball of index 1.5 is 0.01 degrees at 4.8 voxels, 0.6 at 3, and
    2 at 1.8.

    Attributes:
        voxels: thickness, in voxels, below which the spline of one side of a wall contains the fold of the distances in
            its middle.
        few: share of the surface that may belong to thinner parts, such as the surroundings of a sharp edge.
        num_points: number of points at which the thickness is measured.
        beside: distance from a wall to the content of a vessel, as a fraction of the extent of the mesh.
        least_error: median error of exit directions, in degrees, below which thin walls give no warning; a pixel of 400
            covers about 0.1 degrees.
        num_rays: number of rays by which this error is measured.
        most_vertices: largest resolution that the warning recommends.
    """

    voxels: float = 5.0
    few: float = 0.2
    num_points: int = 4096
    beside: float = 2e-3
    least_error: float = 0.1
    num_rays: int = 512
    most_vertices: int = 512


def thickness(
    mesh: TriangleMesh, others: Sequence[TriangleMesh] = (), settings: WallSettings = WallSettings()
) -> Float[np.ndarray, " points"]:
    """Return the distance to the opposite side at random points of a closed surface, world units.

    Args:
        mesh: the surface.
        others: closed surfaces of other bodies. The distance is infinite where one of them is on a side of the wall,
            because light that passes the wall into a liquid depends little on the thickness.
        settings: tuned numbers; `num_points` and `beside` are used.
    """
    settings.use()
    start, inwards = points_below(mesh, settings.num_points)
    intersector = MeshIntersector(mesh.triangles)
    hit = intersector.first_hits(start, inwards)
    start, inwards, hit = start[hit >= 0], inwards[hit >= 0], hit[hit >= 0]
    distance = intersector.distance(start, inwards, hit)
    centre, extent = torch.from_numpy(mesh.bounds.mean(0)), float(np.ptp(mesh.bounds, axis=0).max())
    beside = settings.beside * extent
    sides = [start - beside * inwards, start + (distance + beside)[:, None] * inwards]
    for other in others:
        triangles = MeshIntersector((torch.from_numpy(other.triangles) - centre) / extent)
        for side in sides:
            _, winding = crossings(triangles, (side - centre) / extent, inwards)
            distance = torch.where(winding != 0, torch.inf, distance)
    return distance.numpy()
