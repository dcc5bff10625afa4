"""Dispersion: paths of several wavelengths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch.nn.functional import one_hot

from nerfro.media.solid import Solid
from nerfro.samplers.polylines import SnellTrace
from nerfro.types import Path, Rays


def traced_in_bands(rays: Rays, media: Sequence[Solid], trace: Callable[[Rays, Solid], SnellTrace]) -> SnellTrace:
    """Trace rays at each wavelength; rays that miss the object have one polyline with light of all colours.

    Args:
        rays: camera rays.
        media: bodies with the indices at each wavelength: the bands of red, then of green, then of blue.
        trace: function that traces rays at one wavelength.
    """
    first = trace(rays, media[0])
    bent = first.path.refracted
    rows = first.path.ray[bent].unique_consecutive()
    traces = [first, *(trace(rays[rows], medium) for medium in media[1:])]
    path = Path.joined([trace.path for trace in traces])
    of_rays = [first.path.ray, *(rows[trace.path.ray] for trace in traces[1:])]
    band = torch.cat([torch.full_like(ray, number) for number, ray in enumerate(of_rays)])
    num_bands = len(media) // 3
    # Straight polylines have all colours.
    colours = one_hot(torch.div(band, num_bands, rounding_mode="floor"), 3).to(path.s) / num_bands
    colours = torch.where(path.refracted[:, None], colours, 1.0)
    ray = torch.cat(of_rays)
    order = ray.argsort(stable=True)
    path = replace(path, throughput=path.throughput * colours, band=band, splits=True)
    path = replace(path[order], ray=ray[order])
    num_events, exceeded = (
        torch.cat([getattr(traced, name) for traced in traces])[order] for name in ("num_events", "exceeded")
    )
    return SnellTrace(path, num_events, exceeded)


def refined_in_bands(
    path: Path, rays: Rays, media: Sequence[Solid], refine: Callable[[Path, Rays, Solid], Path]
) -> Path:
    """Refine the polylines of each band in the medium at its wavelength; see `traced_in_bands` for the arguments."""
    rows = [(path.band == band).nonzero()[:, 0] for band in range(len(media))]
    refined = [refine(path[some], rays[path.ray[some]], medium) for some, medium in zip(rows, media, strict=True)]
    return replace(Path.joined(refined)[torch.cat(rows).argsort()], ray=path.ray)
