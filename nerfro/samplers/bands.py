"""Light of several colours, each bent on a path of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import one_hot

from nerfro.media.solid import Solid
from nerfro.types import Path, Rays


@dataclass(frozen=True)
class SnellTrace:
    """Paths and what happened on each polyline."""

    path: Path  # minimal polylines, a vertex for each event beside near and far
    num_events: Int[Tensor, "P"]  # refractions and reflections
    exceeded: Bool[Tensor, "P"]  # whether it met the limit of events; it goes straight on from there


def traced_in_bands(rays: Rays, media: Sequence[Solid], trace: Callable[[Rays, Solid], SnellTrace]) -> SnellTrace:
    """Trace rays in every band's medium; those that miss the object are traced once, with light of all colours.

    Args:
        rays: of all colours.
        media: the same bodies as each band sees them; the bands of red, then those of green, then those of blue.
        trace: for one band.
    """
    first = trace(rays, media[0])
    bent = first.path.refracted
    rows = first.path.ray[bent].unique_consecutive()
    traces = [first, *(trace(rays[rows], medium) for medium in media[1:])]
    path = Path.joined([trace.path for trace in traces])
    of_rays = [first.path.ray, *(rows[trace.path.ray] for trace in traces[1:])]
    band = torch.cat([torch.full_like(ray, number) for number, ray in enumerate(of_rays)])
    num_bands = len(media) // 3
    # One colour, but all of them where nothing is bent.
    colours = one_hot(torch.div(band, num_bands, rounding_mode="floor"), 3).to(path.s) / num_bands
    colours = torch.where(path.refracted[:, None], colours, 1.0)
    ray = torch.cat(of_rays)
    order = ray.argsort(stable=True)
    path = replace(path, throughput=path.throughput * colours, band=band, splits=True)
    path = replace(path[order], ray=ray[order])
    num_events, exceeded = (
        torch.cat([getattr(part, name) for part in traces])[order] for name in ("num_events", "exceeded")
    )
    return SnellTrace(path, num_events, exceeded)


def refined_in_bands(
    path: Path, rays: Rays, media: Sequence[Solid], refine: Callable[[Path, Rays, Solid], Path]
) -> Path:
    """Refine each band's polylines in its medium; arguments as for `traced_in_bands`."""
    rows = [(path.band == band).nonzero()[:, 0] for band in range(len(media))]
    parts = [refine(path[some], rays[path.ray[some]], medium) for some, medium in zip(rows, media, strict=True)]
    return replace(Path.joined(parts)[torch.cat(rows).argsort()], ray=path.ray)
