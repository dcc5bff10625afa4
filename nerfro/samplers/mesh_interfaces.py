"""Snell's law at the triangles of meshes."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from nerfro.geometry.interpolation import intersect_box
from nerfro.media.sdf_grid import SdfGrid
from nerfro.samplers.branching import Branching, Event
from nerfro.samplers.polylines import Crossed, Polylines
from nerfro.samplers.snell_law import reflectance, refract
from nerfro.types import Path, Rays

# A new ray starts this share of the box's diagonal ahead, beyond the rounding of Embree's single precision.
_OFFSET = 1e-6


def snell_on_mesh(
    rays: Rays, medium: SdfGrid, max_events: int, branching: Branching
) -> tuple[Path, Int[Tensor, "P"], Bool[Tensor, "P"]]:
    """Follow rays from triangle to triangle.

    Whether a ray is in a body is known from how often it crossed its surface, not from the triangles' orientation.
    Rays are traced on the CPU, in double precision; the signed distance says which begin inside. Returned are paths,
    the number of events on each polyline, and whether it met the limit.
    """
    triangles, scene = medium.traced_triangles()
    iors = torch.cat([torch.ones(1), medium.iors.detach().cpu()]).double()
    box, device = medium.box.double().cpu(), rays.origins.device
    origins, far = rays.origins.double().cpu(), rays.far.double().cpu()
    d, s = rays.directions.double().cpu().clone(), rays.near.double().cpu().clone()
    x = origins + s[:, None] * d
    rows = torch.arange(len(rays))
    enter, leave = intersect_box(box, x, d)
    active = rows[(enter < leave) & (leave > 0) & (enter < far - s)]
    inside = torch.zeros(len(rays), len(medium.iors), dtype=torch.bool)
    within = active[enter[active] < 0]
    if len(within):
        inside[within] = (medium.signed_distances(x[within].to(medium.box))[0] < 0).cpu()
    lines = Polylines(len(rays), x)
    lines.append(rows, x, d, s, Crossed(medium.innermost(inside)))
    num_events, exceeded = torch.zeros_like(rows), torch.zeros(len(rays), dtype=torch.bool)
    last_face = torch.full_like(rows, -1)
    weight, ray = torch.ones_like(s), rows
    offset = _OFFSET * float(torch.linalg.vector_norm(box[1] - box[0]))
    start = torch.zeros_like(s)
    while len(active):
        face = scene.first_hits(x[active] + start[active, None] * d[active], d[active])
        active, face = active[face >= 0], face[face >= 0]
        length = triangles.distance(x[active], d[active], face)
        # A straight line meets a plane once: the triangle that the ray comes from is found again only by rounding.
        again = face == last_face[active]
        start[active[again]] += offset
        retry, ahead = active[again], ~again
        active, face, length = active[ahead], face[ahead], length[ahead].clamp(min=0)
        flipped = inside[active]
        body = triangles.body[face][:, None]
        flipped = flipped.scatter(1, body, ~flipped.gather(1, body))
        across = medium.innermost(flipped)
        n_before, n_after = iors[medium.innermost(inside[active])], iors[across]
        visible = n_before != n_after
        over = visible & (num_events[active] >= max_events)
        exceeded[active] = over
        hit = x[active] + length[:, None] * d[active]
        normal = triangles.normal(hit, face)
        turned, reflected = refract(d[active], normal, n_before, n_after)
        reflected &= visible
        keep = ~over
        active, face, hit, length, visible = active[keep], face[keep], hit[keep], length[keep], visible[keep]
        turned, reflected, flipped, across = turned[keep], reflected[keep], flipped[keep], across[keep]
        if branching.num_events:
            normal, n_before, n_after = normal[keep], n_before[keep], n_after[keep]
            share = torch.where(visible, reflectance(d[active], normal, n_before, n_after), 0.0)
            event = Event(branching, active, weight, num_events, share, reflected)
            retry = event.row[retry]
            state = (x, d, s, inside, num_events, exceeded, weight, ray, start, last_face)
            x, d, s, inside, num_events, exceeded, weight, ray, start, last_face = (v[event.source] for v in state)
            lines.take(event.source)
            met = (face, hit, length, visible, flipped, across, normal, n_before, n_after)
            face, hit, length, visible, flipped, across, normal, n_before, n_after = (v[event.place] for v in met)
            active, reflected = event.active, event.reflected
            weight[active] *= event.factor
            turned, _ = refract(d[active], normal, n_before, n_after, reflected)
        inside[active] = torch.where(reflected[:, None], inside[active], flipped)
        x[active], s[active], last_face[active] = hit, s[active] + length, face
        start[active] = offset
        d[active] = torch.where(visible[:, None], turned, d[active])
        num_events[active] += visible
        bent = active[visible]
        at_surface = Crossed(
            medium.innermost(inside[bent]), triangles.body[face[visible]], across[visible], face[visible]
        )
        lines.append(bent, x[bent], d[bent], s[bent], at_surface)
        active = torch.cat([active, retry])
    lines.append_ends(far[ray], box, num_events > 0, x, d, s)
    split = (ray, weight) if branching.num_events else (None, None)
    return lines.path(rays, num_events > 0, *split), num_events.to(device), exceeded.to(device)
