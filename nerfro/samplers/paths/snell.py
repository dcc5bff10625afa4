"""Paths of rays that are refracted and reflected at sharp surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool
from torch import Tensor
from torch.nn import functional

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path, Rays
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.registry.allowed import OnlyWith, Positive, Share
from nerfro.registry.registration import register
from nerfro.samplers.base import PathSampler, replay_straight, straight_path
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.compiled import trace_bodies
from nerfro.samplers.paths.polylines import SnellTrace
from nerfro.samplers.paths.replay import intersect_solid, intersect_triangles, replay, smallest_cosine


class Tracer:
    """Trace rays from surface to surface of bodies at one wavelength, by the compiled kernel.

    Args:
        medium: the bodies, with one index for all wavelengths in a call of `trace` or `replay`.
        triangles: whether rays intersect the triangles of the meshes instead of the zero levels of the grids.
    """

    def __init__(self, medium: Bodies, triangles: bool = False) -> None:
        self.medium, self.triangles = medium, triangles

    def trace(self, rays: Rays, max_events: int, branching: Branching) -> SnellTrace:
        """Trace rays without gradients, and count events."""
        return trace_bodies(rays, self.medium, self.medium.tree if self.triangles else None, max_events, branching)

    def replay(self, path: Path, rays: Rays, branching: Branching) -> Path:
        """Return a traced path with gradients; see `samplers.paths.replay`."""
        assert path.record is not None
        if self.triangles:
            intersect = intersect_triangles(self.medium.triangles, path.record.triangle)
        else:
            intersect = intersect_solid(self.medium, path.record.surface_body)
        return replay(path, rays, self.medium, intersect, branching)


class StraightTracer(Tracer):
    """Leave rays straight in a vacuum."""

    def __init__(self) -> None:
        pass

    def trace(self, rays: Rays, max_events: int, branching: Branching) -> SnellTrace:
        return SnellTrace.without_events(straight_path(rays))

    def replay(self, path: Path, rays: Rays, branching: Branching) -> Path:
        return replay_straight(path, rays)


@register("sampler/path", "snell")
class Snell(PathSampler):
    """Trace rays with exact refraction (Snell's law) and reflection (total or Fresnel) at the surfaces of solids.

    Args:
        interface: `sdf` is the zero level of the signed distance, with smooth normals and tolerance of noisy hulls;
            `mesh` is the triangles, with sharp edges, and smooth normals where the triangles sample a smooth surface
            (`shading` of the body). None is `sdf`; a training takes `mesh` if each body has a closed mesh.
        max_events: largest number of refractions and reflections of a ray.
        branches: `none` transmits all light that is not totally reflected, as the paper does; `first` adds the
            reflection at the first surface of a ray; `all` adds all reflections.
        least_weight: share of the light of a ray below which a branch is not followed; the other part takes its weight.
        wavelengths: wavelengths in nm at which rays are traced if the medium disperses: equally many for red, green and
            blue, in this order.
    """

    def __init__(
        self,
        interface: Literal["sdf", "mesh"] | None = None,
        max_events: Annotated[int, Ge(1), Le(1000)] = 16,
        branches: Literal["none", "first", "all"] = "none",
        least_weight: Annotated[Share, OnlyWith("branches", ("first", "all"))] = 0.02,
        wavelengths: Sequence[Positive] = (610.0, 550.0, 465.0),
    ) -> None:
        super().__init__()
        if len(wavelengths) == 0 or len(wavelengths) % 3:
            raise NerfroError(
                f"sampler.path.wavelengths={list(wavelengths)} is not allowed; give as many for red, green, blue"
            )
        self.wavelengths = list(wavelengths)
        self.interface, self.max_events, self.traces_triangles = interface, max_events, interface == "mesh"
        self.branching = Branching({"none": 0, "first": 1, "all": max_events}[branches], least_weight)

    @classmethod
    def settings_for(cls, medium: Medium) -> dict[str, Any]:
        meshes = [] if medium.bodies is None else medium.bodies.meshes
        return {"interface": "mesh" if meshes and all(mesh.is_closed for mesh in meshes) else "sdf"}

    def tracers(self, medium: Medium) -> list[Tracer]:
        """Return the tracers for the surfaces of a medium: one for each wavelength if the medium disperses, else one.

        Raises:
            NerfroError: the medium has no surfaces, or no triangles for `interface=mesh`.
        """
        bodies = medium.bodies
        if medium.is_vacuum:
            return [StraightTracer()]
        if bodies is None:
            raise NerfroError(
                "sampler/path=snell needs a medium with a surface; take medium=sdf_grid, or sampler/path=eikonal"
            )
        if self.traces_triangles:
            if not bodies.meshes:
                raise NerfroError(
                    "sampler.path.interface=mesh needs a medium made of meshes; give each body of medium=sdf_grid a "
                    "mesh, or set sampler.path.interface=sdf"
                )
            bodies.tree  # noqa: B018 (created once, before the variants of all wavelengths share it)
        media = [bodies.at_wavelength(w) for w in self.wavelengths] if bodies.disperses else [bodies]
        return [Tracer(medium, self.traces_triangles) for medium in media]

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace rays from near to far; bent paths end outside the medium's box, beyond far if necessary."""
        return self.trace(rays, medium).path

    @torch.no_grad()
    def trace_main(self, rays: Rays, medium: Medium) -> Path:
        return self.tracers(medium)[0].trace(rays, self.max_events, self.branching._replace(main_only=True)).path

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        """Return the path with gradients with respect to rays, indices and distance grids; see `samplers.paths.replay`.

        Gradients are unbounded at grazing and critical angles; omit paths whose `smallest_cosine` is below 0.15.
        """
        tracers = self.tracers(medium)
        if len(tracers) == 1:
            return tracers[0].replay(path, rays, self.branching)
        return _replay_in_bands(path, rays, tracers, self.branching)

    def steady(self, path: Path, medium: Medium) -> Bool[Tensor, "P"]:
        return smallest_cosine(path, medium) > 0.15

    def releases_gil(self, medium: Medium) -> bool:
        return not medium.is_vacuum

    @torch.no_grad()
    def trace(self, rays: Rays, medium: Medium, branching: Branching | None = None) -> SnellTrace:
        """Trace rays and count events; `branching` replaces the rule of the sampler."""
        tracers = self.tracers(medium)
        settings = self.max_events, branching or self.branching
        return tracers[0].trace(rays, *settings) if len(tracers) == 1 else _traced_in_bands(rays, tracers, *settings)


def _traced_in_bands(rays: Rays, tracers: Sequence[Tracer], max_events: int, branching: Branching) -> SnellTrace:
    """Trace rays at each wavelength; rays that miss the object have one polyline with light of all colours.

    Args:
        rays: camera rays.
        tracers: tracer at each wavelength: the bands of red, then of green, then of blue.
        max_events, branching: see `Tracer.trace`.
    """
    first = tracers[0].trace(rays, max_events, branching)
    bent = first.path.refracted
    rows = first.path.ray[bent].unique_consecutive()
    traces = [first, *(tracer.trace(rays[rows], max_events, branching) for tracer in tracers[1:])]
    path = Path.joined([trace.path for trace in traces])
    of_rays = [first.path.ray, *(rows[trace.path.ray] for trace in traces[1:])]
    band = torch.cat([torch.full_like(ray, number) for number, ray in enumerate(of_rays)])
    num_bands = len(tracers) // 3
    # Straight polylines have all colours.
    colours = functional.one_hot(torch.div(band, num_bands, rounding_mode="floor"), 3).to(path.s) / num_bands
    colours = torch.where(path.refracted[:, None], colours, 1.0)
    ray = torch.cat(of_rays)
    order = ray.argsort(stable=True)
    assert path.record is not None
    record = replace(path.record, band=band)
    path = replace(path, throughput=path.throughput * colours, splits=True, record=record)
    path = replace(path[order], ray=ray[order])
    num_events, exceeded = (
        torch.cat([getattr(traced, name) for traced in traces])[order] for name in ("num_events", "exceeded")
    )
    return SnellTrace(path, num_events, exceeded)


def _replay_in_bands(path: Path, rays: Rays, tracers: Sequence[Tracer], branching: Branching) -> Path:
    """Replay the polylines of each band at its wavelength; see `_traced_in_bands` for the arguments."""
    assert path.record is not None
    rows = [(path.record.band == band).nonzero()[:, 0] for band in range(len(tracers))]
    replayed = [
        tracer.replay(path[some], rays[path.ray[some]], branching) for some, tracer in zip(rows, tracers, strict=True)
    ]
    order, names = torch.cat(rows).argsort(), ("positions", "directions", "s", "throughput")
    columns: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in replayed])[order] for name in names}
    return replace(path, **columns)
