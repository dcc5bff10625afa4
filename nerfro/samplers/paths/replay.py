"""Differentiable replay of traced paths, and the normals of their first surfaces.

A traced path records its surfaces, and whether the ray was refracted or reflected at each. Given the record, every
vertex is a smooth function of the ray, the indices and the surfaces, and the replay computes the first derivatives.
Moving silhouettes, and events that appear or disappear, have no derivatives here; a mask loss is sensitive to both.

Derivatives grow without bound near grazing incidence and near the critical angle; `smallest_cosine` finds such paths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.core.types import Path, Rays
from nerfro.geometry.intersection import Triangles
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.branching import ONE_PATH, Branching
from nerfro.samplers.paths.polylines import distance_to_end
from nerfro.samplers.paths.snell_law import reflectance, refract, turning_normals

# Intersects rays with the recorded surfaces. Arguments: rows and column of the vertices, positions and directions of
# the previous vertices, traced distances, and ratios of the index before the surface to the index behind it. Results,
# with gradients: distances and unit normals.
Intersect = Callable[[Tensor, int, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
# Rows and columns of vertices; their positions, directions and arc lengths.
Vertices = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class _ValueOf(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value: Tensor, replayed: Tensor) -> Tensor:
        ctx.like = replayed.dtype, replayed.device
        return value.clone()

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[None, Tensor]:  # type: ignore[override]
        dtype, device = ctx.like
        return None, gradient.to(device, dtype)


def with_gradient(value: Float[Tensor, "..."], replayed: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Give a traced value the gradient of its replay; the value does not change by rounding errors of the replay."""
    return _ValueOf.apply(value, replayed)


def smallest_cosine(path: Path, medium: Medium) -> Float[Tensor, "P"]:
    """Compute the least |N . d| of each path just before and just after events at sharp surfaces; 1 without events.

    First derivatives of a path are reliable if the cosine is above 0.15. Below, the ray grazes a surface or is near the
    critical angle, and the derivatives grow without bound. Surfaces at which the index does not change do not count.
    """
    if path.record is None:
        return torch.ones_like(path.s[:, 0])
    with torch.no_grad():
        n = indices_of(medium, path.s)[path.record.body.long()]
        before, after = path.directions[:, :-1], path.directions[:, 1:]
        normals = turning_normals(before, after, n[:, :-1], n[:, 1:])
        cosines = torch.minimum((normals * before).sum(-1).abs(), (normals * after).sum(-1).abs())
        return torch.where((path.record.surface_body[:, 1:] > 0) & normals.any(-1), cosines, 1.0).amin(-1)


def indices_of(medium: Medium, like: Tensor) -> Float[Tensor, " media"]:
    """Return the refractive index of air and of each body, with gradients."""
    return torch.cat([like.new_ones(1), medium.iors.to(like)])


def replay(path: Path, rays: Rays, medium: Medium, intersect: Intersect, branching: Branching = ONE_PATH) -> Path:
    """Replay paths of refractions and reflections, with gradients with respect to rays, indices and surfaces.

    Each event is an intersection with the recorded surface, and refraction or reflection as in the trace. Derivatives
    are taken at the traced vertices, and all values are equal to the traced values.
    """
    record = path.record
    assert record is not None
    origins, d, s = (path.broadcast_to_polylines(values) for values in (rays.origins, rays.directions, rays.near))
    x = origins + s[:, None] * d
    num_paths, num_vertices = path.s.shape
    rows, column = torch.arange(num_paths, device=s.device), torch.zeros_like(path.ray)
    vertices: list[Vertices] = [(rows, column, x, d, s)]
    indices = indices_of(medium, path.s)
    weight, num_events = torch.ones_like(s), torch.zeros_like(path.ray)
    for i in range(1, num_vertices - 1):
        rows = (record.surface_body[:, i] > 0).nonzero().squeeze(1)
        if not len(rows):
            break
        old_x, old_d, old_s = (with_gradient(values[rows, i - 1], replayed[rows]) for values, replayed in (
            (path.positions, x), (path.directions, d), (path.s, s)))  # fmt: skip
        before, after, far_side = (numbers[rows].long() for numbers in (
            record.body[:, i - 1], record.body[:, i], record.far_side[:, i]))  # fmt: skip
        reflected, ratio = after != far_side, (indices[before] / indices[far_side]).detach()
        length, normal = intersect(rows, i, old_x, old_d, path.s[rows, i] - path.s[rows, i - 1], ratio)
        outgoing, _ = refract(old_d, normal, indices[before], indices[far_side], reflected)
        if (num_events[rows] < branching.max_split_events).any():
            visible = indices[before] != indices[far_side]
            share = torch.where(visible, reflectance(old_d, normal, indices[before], indices[far_side]), 0.0)
            splits, _ = branching.decide(weight[rows].detach(), share.detach(), num_events[rows])
            num_events[rows] += visible
            factor = torch.where(splits, torch.where(reflected, share, 1 - share), 1.0)
            weight = weight.index_copy(0, rows, weight[rows] * factor)
        vertex = old_x + length[:, None] * old_d, outgoing, old_s + length
        vertices.append((rows, torch.full_like(rows, i), *vertex))
        x, d, s = (old.index_copy(0, rows, new) for old, new in zip((x, d, s), vertex, strict=True))
    replayed = assembled(path, rays, medium, vertices, (x, d, s))
    if not branching.max_split_events:
        return replayed
    relative = (weight / weight.detach())[:, None]
    return replace(replayed, throughput=with_gradient(path.throughput, path.throughput * relative))


def assembled(
    path: Path, rays: Rays, medium: Medium, vertices: list[Vertices], last: tuple[Tensor, Tensor, Tensor]
) -> Path:
    """Give a traced path the gradients of replayed vertices.

    Args:
        path: traced path.
        rays: traced rays.
        medium: medium, whose box determines the end of bent paths.
        vertices: replayed vertices; other vertices between the ends have no gradients.
        last: position, direction and arc length of each row after the last event.
    """
    x, d, s = last
    ahead = distance_to_end(path.broadcast_to_polylines(rays.far).to(s), medium.box, path.refracted, x, d, s)
    end = torch.cat([x + ahead[:, None] * d, d, (s + ahead)[:, None]], -1)
    rows, columns = (torch.cat([vertex[i] for vertex in vertices]) for i in range(2))
    values = torch.cat([torch.cat([*vertex[2:4], vertex[4][:, None]], -1) for vertex in vertices])
    replayed = torch.where(is_interior(path)[..., None], torch.zeros_like(end)[:, None], end[:, None])
    replayed = replayed.index_put((rows, columns), values)
    return replace(
        path,
        positions=with_gradient(path.positions, replayed[..., :3]),
        directions=with_gradient(path.directions, replayed[..., 3:6]),
        s=with_gradient(path.s, replayed[..., 6]),
    )


def is_interior(path: Path) -> Bool[Tensor, "P S"]:
    """Return which vertices are neither the first vertex nor at the end, which short rows repeat."""
    return (path.s < path.s[:, -1:]) & (torch.arange(path.s.shape[1], device=path.s.device) > 0)


def intersect_solid(medium: Bodies, surface: Int[Tensor, "P S"]) -> Intersect:
    """Intersect rays with zero levels of signed distances: t <- t - phi(x + t d) / (grad phi . d), divisor detached.

    Args:
        medium: traced bodies.
        surface: body on whose surface each vertex lies, `OpticalRecord.surface_body`.
    """

    def intersect(
        rows: Tensor, column: int, x: Tensor, d: Tensor, length: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        body = surface[rows, column].long()[:, None, None] - 1
        phi, gradients = medium.signed_distances(x + length[:, None] * d)
        slope = (gradients.take_along_dim(body, 1)[:, 0] * d).sum(-1).detach()
        # The cosine between ray and normal has a lower bound, so that gradients stay finite.
        slope = torch.copysign(slope.abs().clamp(min=1e-6), slope)
        length = with_gradient(length, length - phi.gather(-1, body[:, 0])[:, 0] / slope)
        _, gradients = medium.signed_distances(x + length[:, None] * d)
        return length, functional.normalize(gradients.take_along_dim(body, 1)[:, 0], dim=-1)

    return intersect


def intersect_triangles(triangles: Triangles, triangle: Int[Tensor, "P S"]) -> Intersect:
    """Intersect rays with triangles of meshes, on the CPU and in double precision.

    Normals are interpolated, unless reflected light would leave behind a triangle or refracted light before it.

    Args:
        triangles: traced triangles.
        triangle: recorded triangle of each vertex.
    """

    def intersect(
        rows: Tensor, column: int, x: Tensor, d: Tensor, length: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        like, face = length, triangle[rows, column].long().cpu()
        x, d = x.cpu().double(), d.cpu().double()
        length = triangles.distance(x, d, face)
        smooth = triangles.normal(x + length[:, None] * d, face)
        flat = functional.normalize(triangles.areas(face), dim=-1)
        normal = torch.where(_stays_on_its_side(d, smooth, flat, ratio.to(d))[:, None], smooth, flat)
        return length.to(like), normal.to(like)

    return intersect


@torch.no_grad()
def _stays_on_its_side(
    d: Float[Tensor, "R 3"], smooth: Float[Tensor, "R 3"], flat: Float[Tensor, "R 3"], ratio: Float[Tensor, "R"]
) -> Bool[Tensor, "R"]:
    """Test that smooth normals send reflected light before a triangle and refracted light behind it.

    Args:
        d: unit directions of arriving rays.
        smooth: interpolated unit normals.
        flat: unit normals of the planes of the triangles.
        ratio: ratio of the index before the triangle to the index behind it.
    """
    n_behind, all_reflect = torch.ones_like(ratio), torch.ones_like(ratio, dtype=torch.bool)
    mirrored, _ = refract(d, smooth, ratio, n_behind, all_reflect)
    bent, is_total = refract(d, smooth, ratio, n_behind)
    height, mirrored_height, bent_height = ((directions * flat).sum(-1) for directions in (d, mirrored, bent))
    return (mirrored_height * height < 0) & (is_total | (bent_height * height > 0))


def first_normals(path: Path, medium: Medium) -> Float[Tensor, "R 3"]:
    """Compute unit normals, towards the camera, at the first event of each ray; zero for rays without events.

    If the index varies continuously, the normals of its level surfaces at the first bend of each path are returned.
    """
    turning = path.refracted.nonzero()[:, 0]  # only few rays of an image
    bent = path[turning]
    rows = torch.arange(len(turning), device=path.s.device)
    before, after = bent.directions[:, :-1], bent.directions[:, 1:]
    body = torch.zeros_like(bent.s).long() if bent.record is None else bent.record.body.long()
    n = indices_of(medium, bent.s).detach()[body]
    events = (before != after).any(-1) | (n[:, :-1] != n[:, 1:])
    first = events.byte().argmax(-1)
    arriving = before[rows, first]
    if medium.bodies is not None:
        normals = turning_normals(arriving, after[rows, first], n[rows, first], n[rows, first + 1])
    else:
        _, normals = medium(bent.positions[rows, first + 1])
    towards = -(normals * arriving).sum(-1, keepdim=True).sign()
    normals = torch.where(events.any(-1, keepdim=True), functional.normalize(normals * towards, dim=-1), 0.0)
    all_normals = path.directions.new_zeros(len(path.s), 3)
    all_normals[turning] = normals.to(all_normals)
    return path.main_polyline(all_normals)
