"""Traced paths with gradients: the same polylines again.

A trace knows what happened: which surfaces were met, and whether the ray was refracted or reflected there. With that
given, every vertex is a smooth function of the ray, the indices and the surfaces, and this is its first derivative.
What only another trace can find has none: a silhouette that moves, an event that appears or goes. Masks see those.

Derivatives grow without bound where a ray grazes a surface or nears the critical angle; `smallest_cosine` finds such
paths, so that a loss can leave them out.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.geometry.intersection import MeshIntersector, Triangles
from nerfro.media.base import Medium
from nerfro.media.solid import Solid
from nerfro.samplers.branching import ONE_PATH, Branching
from nerfro.samplers.polylines import distance_to_end
from nerfro.samplers.snell_law import reflectance, refract
from nerfro.types import Path, Rays

# Cosine between ray and normal below which a surface's distance is no longer divided by it: gradients stay finite.
_MIN_COSINE = 1e-6
# How far before a vertex its triangle is looked for and how far off it may be found, as shares of the distance to the
# origin: some roundings of single precision, in which paths and Embree may be.
_NEAR_TRIANGLE = 1e-5
# Sine of the angle between the normal that a trace has used and that of the triangle which is found again.
_SAME_NORMAL = 1e-3

# Where rays meet a surface. From the last vertex and the direction in which it was left, the traced distance, the body
# if it is known (numbered from 1, else 0) and the traced normal: the distance and the normal, with gradients.
Meet = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
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
    """A traced value, bit for bit, with the gradient of its replay, which may have been rounded otherwise."""
    return _ValueOf.apply(value, replayed)


def smallest_cosine(path: Path, medium: Medium) -> Float[Tensor, "P"]:
    """Least |N . d| of a path just before and just after its events at sharp surfaces; 1 where there is none.

    First derivatives of the path are sound where this is above 0.15; below, the ray grazes a surface or leaves one
    near the critical angle, and they grow without bound. The normals are read off the path, see `turning_normals`.
    """
    with torch.no_grad():
        n = indices_of(medium, path.s)[path.body.long()]
        before, after = path.directions[:, :-1], path.directions[:, 1:]
        normals = turning_normals(before, after, n[:, :-1], n[:, 1:])
        cosines = torch.minimum((normals * before).sum(-1).abs(), (normals * after).sum(-1).abs())
        return torch.where(events(path)[:, 1:], cosines, 1.0).amin(-1)


def turning_normals(
    before: Float[Tensor, "*batch 3"],
    after: Float[Tensor, "*batch 3"],
    n_before: Float[Tensor, "*batch"],
    n_after: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3"]:
    """Unit normals of the surfaces that turn unit directions: by Snell's law n d changes along the normal alone."""
    change = n_before[..., None] * before - n_after[..., None] * after
    return functional.normalize(change, dim=-1, eps=torch.finfo(change.dtype).tiny)


def indices_of(medium: Medium, like: Tensor) -> Float[Tensor, "M"]:
    """Refractive index of air and of each body, with gradients."""
    bodies = [medium.iors] if isinstance(medium, Solid) else []
    return torch.cat([like.new_ones(1), *(iors.to(like) for iors in bodies)])


def events(path: Path) -> Bool[Tensor, "P S"]:
    """Which vertices are neither the first one nor the end, which shorter rows repeat."""
    return (path.s < path.s[:, -1:]) & (torch.arange(path.s.shape[1], device=path.s.device) > 0)


def start_of(path: Path, rays: Rays) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"], Float[Tensor, "P"]]:
    """First vertices, with gradients by the rays."""
    origins, d, s = (path.of_ray(values) for values in (rays.origins, rays.directions, rays.near))
    return origins + s[:, None] * d, d, s


def replay(path: Path, rays: Rays, medium: Medium, meet: Meet, branching: Branching = ONE_PATH) -> Path:
    """Paths of refractions and reflections, and their throughput, with gradients by rays, indices and surfaces.

    Event by event the ray goes on to the surface, and there Snell's law holds, or reflection where the trace reflected.
    Derivatives are taken at the traced vertices, and every value stays that of the trace.
    """
    x, d, s = start_of(path, rays)
    num_paths, num_vertices = path.s.shape
    rows, column = torch.arange(num_paths, device=s.device), torch.zeros_like(path.ray)
    vertices: list[Vertices] = [(rows, column, x, d, s)]
    happens, indices = events(path), indices_of(medium, path.s)
    nested = isinstance(medium, Solid) and medium.nested
    weight = torch.ones_like(s)
    for i in range(1, num_vertices - 1):
        rows = happens[:, i].nonzero().squeeze(1)
        if not len(rows):
            break
        old_x, old_d, old_s = (with_gradient(values[rows, i - 1], replayed[rows]) for values, replayed in (
            (path.positions, x), (path.directions, d), (path.s, s)))  # fmt: skip
        before, after = path.body[rows, i - 1].long(), path.body[rows, i].long()
        reflected = before == after
        normal = turning_normals(old_d, path.directions[rows, i], indices[before], indices[after]).detach()
        length = path.s[rows, i] - path.s[rows, i - 1]
        body = torch.where(reflected | nested, 0, torch.maximum(before, after))
        length, normal = meet(old_x, old_d, length, body, normal)
        turned, _ = refract(old_d, normal, indices[before], indices[after], reflected)
        if i <= branching.num_events and isinstance(medium, Solid):
            with torch.no_grad():
                across = torch.where(reflected, _beyond(medium, old_x, old_d, length), after)
            share = reflectance(old_d, normal, indices[before], indices[across])
            splits, _ = branching.decide(weight[rows].detach(), share.detach(), torch.full_like(rows, i - 1))
            factor = torch.where(splits, torch.where(reflected, share, 1 - share), 1.0)
            weight = weight.index_copy(0, rows, weight[rows] * factor)
        vertex = old_x + length[:, None] * old_d, turned, old_s + length
        vertices.append((rows, torch.full_like(rows, i), *vertex))
        x, d, s = (old.index_copy(0, rows, new) for old, new in zip((x, d, s), vertex, strict=True))
    replayed = assembled(path, rays, medium, vertices, (x, d, s))
    if not branching.num_events:
        return replayed
    relative = (weight / weight.detach())[:, None]
    return replayed.changed(throughput=with_gradient(path.throughput, path.throughput * relative))


def _beyond(
    medium: Solid, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"], length: Float[Tensor, "R"]
) -> Int[Tensor, "R"]:
    """Body beyond the surface that rays from x meet after a length, though they may be reflected there."""
    inside = medium.signed_distances(x + 0.5 * length[:, None] * d)[0] < 0
    body = medium.signed_distances(x + length[:, None] * d)[0].abs().argmin(-1, keepdim=True)
    return medium.innermost(inside.scatter(1, body, ~inside.gather(1, body)))


def assembled(
    path: Path, rays: Rays, medium: Medium, vertices: list[Vertices], last: tuple[Tensor, Tensor, Tensor]
) -> Path:
    """A traced path with the gradients of its replayed vertices.

    Args:
        path: traced.
        rays: that were traced.
        medium: at whose box bent paths end.
        vertices: replayed; a vertex between the ends that is not among them has no gradient.
        last: position, direction and arc length of each row after its last event.
    """
    x, d, s = last
    ahead = distance_to_end(path.of_ray(rays.far).to(s), medium.box, path.refracted, x, d, s)
    end = torch.cat([x + ahead[:, None] * d, d, (s + ahead)[:, None]], -1)
    rows, columns = (torch.cat([vertex[i] for vertex in vertices]) for i in range(2))
    values = torch.cat([torch.cat([*vertex[2:4], vertex[4][:, None]], -1) for vertex in vertices])
    replayed = torch.where(events(path)[..., None], torch.zeros_like(end)[:, None], end[:, None])
    replayed = replayed.index_put((rows, columns), values)
    return path.moved(
        with_gradient(path.positions, replayed[..., :3]),
        with_gradient(path.directions, replayed[..., 3:6]),
        with_gradient(path.s, replayed[..., 6]),
        with_gradient(path.exit_directions, d),
    )


def meet_solid(medium: Solid) -> Meet:
    """Meet the zero levels of signed distances: t <- t - phi(x + t d) / (grad phi . d), the divisor without gradient.

    The body of a reflection, and any of a nested medium, is the one whose surface is nearest.
    """

    def meet(x: Tensor, d: Tensor, length: Tensor, body: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        phi, gradients = medium.signed_distances(x + length[:, None] * d)
        body = torch.where(body > 0, body - 1, phi.abs().argmin(-1))
        slope = (_of_body(gradients, body) * d).sum(-1).detach()
        slope = torch.copysign(slope.abs().clamp(min=_MIN_COSINE), slope)
        length = with_gradient(length, length - phi.gather(-1, body[:, None])[:, 0] / slope)
        _, gradients = medium.signed_distances(x + length[:, None] * d)
        return length, functional.normalize(_of_body(gradients, body), dim=-1)

    return meet


def _of_body(gradients: Float[Tensor, "R K 3"], body: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
    return gradients.gather(1, body[:, None, None].expand(-1, 1, 3))[:, 0]


def meet_triangles(triangles: Triangles, scene: MeshIntersector) -> Meet:
    """Meet the triangles that rays have hit, on the CPU and in double precision.

    A triangle that is not found again, as in a gap of rounding between two, is replaced by a fixed plane.
    """

    def meet(x: Tensor, d: Tensor, length: Tensor, body: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        like = length
        x, d, length, normal = (tensor.cpu().double() for tensor in (x, d, length, normal))
        hit = (x + length[:, None] * d).detach()
        with torch.no_grad():
            reach = _NEAR_TRIANGLE * (1 + torch.linalg.vector_norm(hit, dim=-1))
            face = scene.first_hits(hit - torch.minimum(reach, 0.5 * length)[:, None] * d, d)
            found = triangles.distance(x, d, face.clamp(min=0))
            across = torch.linalg.cross(triangles.normal(hit, face.clamp(min=0)), normal)
            good = (face >= 0) & ((found - length).abs() < reach) & (across.square().sum(-1) < _SAME_NORMAL**2)
        rows = good.nonzero().squeeze(1)
        slope = (normal * d).sum(-1)
        slope = torch.where(slope.abs() < _MIN_COSINE, _MIN_COSINE, slope)
        length = ((hit - x) * normal).sum(-1) / slope
        length = length.index_copy(0, rows, triangles.distance(x[rows], d[rows], face[rows]))
        at = x[rows] + length[rows, None] * d[rows]
        normal = normal.index_copy(0, rows, triangles.normal(at, face[rows]))
        return length.to(like), normal.to(like)

    return meet
