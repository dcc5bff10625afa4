"""Snell's law at the triangles of meshes."""

from __future__ import annotations

import torch

from nerfro.media.sdf_grid import SdfGrid
from nerfro.samplers.branching import Branching
from nerfro.samplers.polylines import SnellTrace
from nerfro.samplers.wavefront import Wavefront
from nerfro.types import Rays

# The search for the next triangle begins at this share of the box's diagonal from the last one, beyond the rounding
# errors of Embree's single precision.
_OFFSET = 1e-6


def snell_on_mesh(rays: Rays, medium: SdfGrid, max_events: int, branching: Branching) -> SnellTrace:
    """Trace rays from triangle to triangle, on the CPU and in double precision.

    The number of crossings of its surface determines whether a ray is inside a body; the orientation of triangles does
    not matter. Signed distances determine which rays begin inside.
    """
    triangles, scene = medium.traced_triangles()
    box = medium.box.double().cpu()
    offset = _OFFSET * float(torch.linalg.vector_norm(box[1] - box[0]))
    front = Wavefront(rays.to("cpu").to(torch.float64), medium, box, max_events, branching, offset, scene.num_layers)
    within = (front.moving & (front.enter < 0)).nonzero()[:, 0]
    if len(within):
        front.inside[within] = (medium.signed_distances(front.x[within].to(medium.box))[0] < 0).cpu()
    front.add_vertices(front.ray)
    while len(rows := front.moving.nonzero()[:, 0]):
        faces = scene.first_hits(front.x[rows] + front.start[rows, None] * front.d[rows], front.d[rows])
        hit = (faces >= 0).any(1)
        front.moving[rows] = hit
        rows, faces = rows[hit], faces[hit]
        # A straight line meets a plane once, so finding a triangle of the last vertex again is a rounding error.
        again = ((faces[:, :, None] == front.triangles[rows][:, None]) & (faces >= 0)[:, :, None]).any((1, 2))
        front.start[rows[again]] += offset
        rows, faces = rows[~again], faces[~again]
        lengths = triangles.distance(front.x[rows, None], front.d[rows, None], faces).clamp(min=0)
        lengths, order = torch.where(faces >= 0, lengths, torch.inf).sort(1)
        faces, length = faces.gather(1, order), lengths[:, 0]
        # All triangles at one distance count, because the ray continues behind them.
        faces = torch.where(lengths <= length[:, None] + offset, faces, -1)
        body = torch.where(faces >= 0, triangles.body[faces], -1)
        normal = triangles.normal(front.x[rows] + length[:, None] * front.d[rows], faces[:, 0])
        front.meet(rows, length, length, body, normal, faces)
    return front.finish(rays)
