"""Fit of the lengths of an open drinking glass to photographs.

Rays through pixels of the object are traced with all reflections, and the colours of the pixels are compared with the
known surroundings in the exit directions. A thin wall hardly bends rays, so that most of the information comes from
reflections, the foot and the liquid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from nerfro.capture.object_errors import (
    COMMON_INDICES,
    ObjectErrors,
    ObjectErrorSettings,
    mean_errors,
    parabola_minimum,
    standard_error,
)
from nerfro.capture.surroundings import Observations
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import counting_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.bodies import Bodies, GridSettings
from nerfro.media.body_settings import expanded
from nerfro.media.material import Material
from nerfro.media.surfaces import MeshSurface, direction
from nerfro.media.vessel import VesselLengths, extent, vessel, with_lengths
from nerfro.silhouettes.upright import find_up

_GLASS, _WATER = COMMON_INDICES["glass"], COMMON_INDICES["water"]


@dataclass(frozen=True)
class VesselFitSettings(AlgorithmSettings):
    """Settings of the fit of a vessel (`fit_vessel`).

    Attributes:
        wall, foot, fillet: lengths of a typical glass, as fractions of its width.
        max_fillet: largest candidate of the fillet, as a fraction of the width. Distances of the cavity are exact to
            this depth and twice the typical wall.
        stem: a slice is part of a stem if it is narrower than this fraction of the widest slices below and above it.
        num_slices: number of slices in which a stem is searched.
        levels: levels of a liquid that are compared with an empty glass, as fractions of the height.
        max_level: highest level, as a fraction of the height, and thickest foot, as a fraction of the level or of the
            height: lengths of four digits stay below.
        rounds: half width of the grid of candidates in each round: a factor for lengths, and a fraction of the height
            for the level, and for the foot above a stem.
        num_candidates: number of candidates of each length in each round.
        num_errors: a vessel contains a liquid if the liquid decreases the error by this number of standard errors. An
            uncertain length is kept if it decreases the error of the typical length by this number.
        max_standard_error: largest standard error of a certain length, relative to the length. The last grid limits the
            error to about 0.4, and for the level and the foot above a stem to a few percent, so that these are certain.
        errors: settings of the errors at pixels of the object.
    """

    wall: float = 0.02
    foot: float = 0.06
    fillet: float = 0.1
    max_fillet: float = 0.4
    stem: float = 0.3
    num_slices: int = 48
    levels: tuple[float, ...] = (0.3, 0.5, 0.7, 0.9)
    max_level: float = 0.999
    rounds: tuple[tuple[float, float], ...] = ((2.0, 0.1), (1.5, 0.06), (1.5, 0.03))
    num_candidates: int = 5
    num_errors: float = 2.0
    max_standard_error: float = 0.2
    errors: ObjectErrorSettings = field(default=ObjectErrorSettings(), repr=False)


@dataclass(frozen=True)
class VesselFit:
    """Lengths of a vessel.

    Attributes:
        lengths: wall, foot, fillet, and level if there is a liquid, world units.
        standard_errors: standard error of each length by resampling of the views; errors of the surface are not
            included.
        unknown: lengths that the photographs do not determine, which keep their typical values.
    """

    lengths: dict[str, float]
    standard_errors: dict[str, float]
    unknown: list[str]


def find_vessel(
    medium: Bodies, settings: Mapping[str, Any], mesh: TriangleMesh, observations: Observations
) -> tuple[dict[str, object], Bodies | None]:
    """Fit a vessel to the photographs, print its lengths, and return the settings of the medium, and the medium.

    Args:
        medium: solid body with the outer surface.
        settings: settings of the medium, with the file of the outer surface as mesh of the first body.
        mesh: the outer surface, in the coordinates that `observations.shift` refers to.
        observations: observations of the object and its surroundings.

    Returns:
        Settings of the vessel except its mesh, and the vessel; none if the surface leaves no cavity.
    """
    upright = find_up(observations.views.cameras, mesh)
    up = [0.0, 0.0, 1.0] if upright is None else [round(float(x), 4) for x in upright[0]]
    across = mesh.vertices - np.outer(mesh.vertices @ np.array(up), up)
    first = medium.grids[0]
    low, high = (first.box.double().numpy() + medium.origin).tolist()
    grid, upwards = GridSettings(len(first.distances), low, high), direction("up", up)
    body = next(iter(expanded(settings).values()))
    shading = body.shading or "auto", body.crease_degrees
    outer = MeshSurface(str(body.mesh), settings.get("accept_open_mesh", False), *shading)
    lowest, highest = extent(outer, upwards)
    height = highest - lowest

    def build(lengths: VesselLengths) -> Bodies:
        liquid = None if lengths.level is None else Material(_WATER)
        return vessel(outer, lengths, Material(_GLASS), liquid, up, grid=grid)

    try:
        stem = stem_height(mesh, upwards)
        fit = fit_vessel(build, float(np.ptp(across, axis=0).max()), height, observations, stem)
        rounded = {name: float(f"{length:.4g}") for name, length in fit.lengths.items()}
        fitted = build(VesselLengths(**rounded))
    except NerfroError as error:
        warn(f"no vessel is fitted: {error}")
        return {}, None
    values = [
        f"{name} {value:.3g}" + ("" if name in fit.unknown else f" +- {fit.standard_errors[name]:.2g}")
        for name, value in fit.lengths.items()
    ]
    liquid_ior = _WATER if "level" in rounded else 1.0
    print(f"vessel, {'with a liquid' if liquid_ior > 1 else 'empty'}: {', '.join(values)}, height {height:.3g}")
    if fit.unknown:
        kept = " and ".join(f"{name} {fit.lengths[name]:.3g}" for name in fit.unknown)
        warn(f"typical values are kept, because the photographs do not determine them: {kept}")
    return {"up": up, "ior": _GLASS, "liquid_ior": liquid_ior} | rounded, fitted


def stem_height(
    mesh: TriangleMesh, up: Float[np.ndarray, "3"], settings: VesselFitSettings = VesselFitSettings()
) -> float:
    """Return the height of the upper end of a stem above the lowest point; 0 for a vessel without a stem.

    Args:
        mesh: closed outer surface.
        up: unit direction from bottom to top.
        settings: number of slices, and the limit of their width.

    Raises:
        NerfroError: a slice between bottom and top is empty.
    """
    heights = mesh.vertices @ up
    slice_height = np.ptp(heights) / settings.num_slices
    middles = heights.min() + (np.arange(settings.num_slices) + 0.5) * slice_height
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    sections, _, _ = trimesh.intersections.mesh_multiplane(solid, np.zeros(3), up, middles)
    if not all(map(len, sections)):
        raise NerfroError("the surface has separate parts above each other; keep the largest with keep=1")
    width = np.array([np.ptp(section.reshape(-1, 2), axis=0).max() for section in sections])
    below, beyond = np.maximum.accumulate(width), np.maximum.accumulate(width[::-1])[::-1]
    stem = np.flatnonzero(width < settings.stem * np.minimum(below, beyond))
    return float((stem[-1] + 1) * slice_height) if len(stem) else 0.0


def fit_vessel(
    build: Callable[[VesselLengths], Bodies],
    width: float,
    height: float,
    observations: Observations,
    stem: float = 0.0,
    settings: VesselFitSettings = VesselFitSettings(),
) -> VesselFit:
    """Fit wall, foot, fillet and level of an open vessel.

    Args:
        build: makes the vessel from its lengths, with water if they have a level.
        width, height: size of the outer surface, world units.
        observations: observations of the object and its surroundings.
        stem: height of the upper end of a stem, 0 without one. A stem is solid, so that the cavity does not begin below
            this height.
        settings: typical lengths, candidates and limits.
    """
    settings.use()
    typical = {name: getattr(settings, name) * width for name in ("wall", "foot", "fillet")}
    typical["foot"] = max(typical["foot"], stem + typical["wall"]) if stem else typical["foot"]
    widest = typical | {"fillet": settings.max_fillet * width}  # distances are exact up to this depth
    highest = settings.max_level * height
    empty, filled = build(VesselLengths(**widest)), build(VesselLengths(**widest, level=highest))
    heights = [level * height for level in settings.levels]
    levels: list[dict[str, float]] = [{}, *({"level": h} for h in heights if h > typical["foot"])]
    work = 1 + len(levels) + len(settings.rounds) * (len(typical) + 1) * settings.num_candidates

    def error_of(lengths: dict[str, float]) -> Float[np.ndarray, "V"]:
        return search.of(with_lengths(filled if "level" in lengths else empty, VesselLengths(**lengths)))

    with counting_bar("vessel", work) as advance:
        search = ObjectErrors(observations, advance, settings.errors)
        errors = [error_of(typical | level) for level in levels]
        best = int(np.argmin([search.mean(error) for error in errors]))
        typical |= levels[best] if best and search.decreases(errors[0], errors[best], settings.num_errors) else {}
        lengths, standard_errors = dict(typical), dict[str, float]()
        for factor, fraction in settings.rounds:
            for name in typical:
                is_height = name == "level" or (name == "foot" and stem > 0)
                half_width = fraction * height if is_height else np.log(factor)
                middle = lengths[name] if is_height else np.log(lengths[name])
                low, high = _limits(name, lengths, widest["fillet"], height, stem, settings)
                first = max(min(middle - half_width, high - 2 * half_width), low)
                grid = np.linspace(first, min(first + 2 * half_width, high), settings.num_candidates)
                values = grid if is_height else np.exp(grid)
                sums = np.stack([error_of(lengths | {name: value}) for value in values.tolist()])
                # Robust errors have narrow minima, which a quadratic function through all candidates would miss.
                minimum = parabola_minimum(grid, mean_errors(sums, search.counts))[0]
                minima = parabola_minimum(grid, mean_errors(sums, search.counts, search.samples))
                spread = float(standard_error(minima, search.counts))
                lengths[name] = float(minimum if is_height else np.exp(minimum))
                standard_errors[name] = spread if is_height else spread * lengths[name]
        uncertain = [name for name in typical if standard_errors[name] > settings.max_standard_error * lengths[name]]
        fitted = error_of(lengths) if uncertain else np.empty(0)
        without = {name: error_of(lengths | {name: typical[name]}) for name in uncertain}
        unknown = [name for name in uncertain if not search.decreases(without[name], fitted, settings.num_errors)]
    lengths |= {name: typical[name] for name in unknown}
    lengths["foot"] = min(lengths["foot"], settings.max_level * lengths.get("level", height))  # also a typical foot
    return VesselFit(lengths, standard_errors, unknown)


def _limits(
    name: str,
    lengths: Mapping[str, float],
    max_fillet: float,
    height: float,
    stem: float,
    settings: VesselFitSettings,
) -> tuple[float, float]:
    """Return the limits of the candidates for a length: heights, or logarithms of other lengths."""
    below_level = settings.max_level * lengths.get("level", height)
    match name:
        case "foot":
            return (stem, below_level) if stem else (-np.inf, np.log(below_level))
        case "fillet":
            return -np.inf, np.log(max_fillet)
        case "level":
            return lengths["foot"] / settings.max_level, settings.max_level * height
        case _:
            return -np.inf, np.inf
