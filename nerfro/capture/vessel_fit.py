"""Fit of the lengths of an open drinking glass to photographs.

Rays through pixels of the object are traced with all reflections, and the colours of the pixels are compared with the
known surroundings in the exit directions. A thin wall hardly bends rays, so that most of the information comes from
reflections, the foot and the liquid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nerfro.capture.grid_search import mean_errors, parabola_minimum, standard_error
from nerfro.capture.object_errors import COMMON_INDICES, ObjectErrors, ObjectErrorSettings
from nerfro.capture.surroundings import Observations
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import fraction_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.vessel import SdfVessel
from nerfro.silhouettes.upright import find_up

_GLASS, _WATER = COMMON_INDICES["glass"], COMMON_INDICES["water"]


@dataclass(frozen=True)
class VesselFitSettings(AlgorithmSettings):
    """Settings of the fit of a vessel (`fit_vessel`).

    Attributes:
        wall, foot, fillet: lengths of a typical glass, as fractions of its width.
        max_fillet: largest fillet, as a fraction of the width.
        levels: levels of a liquid that are compared with an empty glass, as fractions of the height.
        max_level: highest level, as a fraction of the height; a level of four digits stays below the height.
        rounds: half width of the grid of candidates in each round: a factor for lengths, and a fraction of the height
            for the level.
        num_candidates: number of candidates of each length in each round.
        num_errors: a vessel contains a liquid if the liquid decreases the error by this number of standard errors.
        max_standard_error: largest standard error of a known length, relative to the length; the last grid limits the
            error to about 0.4.
        errors: settings of the errors at pixels of the object.
    """

    wall: float = 0.02
    foot: float = 0.06
    fillet: float = 0.1
    max_fillet: float = 0.4
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
    medium: SdfGrid,
    location: str,
    mesh: TriangleMesh,
    observations: Observations,
    settings: VesselFitSettings = VesselFitSettings(),
) -> tuple[dict[str, object], SdfVessel | None]:
    """Fit a vessel to the photographs, print its lengths, and return the settings of the medium, and the medium.

    Args:
        medium: solid body with the outer surface.
        location: file of the outer surface.
        mesh: the outer surface.
        observations: observations of the object and its surroundings.
        settings: settings of the fit.

    Returns:
        Settings of the vessel except its mesh, and the vessel; none if the surface leaves no cavity.
    """
    estimate = find_up(observations.views.cameras, mesh)
    up = [0.0, 0.0, 1.0] if estimate is None else [round(float(x), 4) for x in estimate[0]]
    across = mesh.vertices - np.outer(mesh.vertices @ np.array(up), up)
    grid = medium.grids[0]
    box = (grid.box.double().numpy() + medium.origin).tolist()

    def build(**options: Any) -> SdfVessel:
        return SdfVessel(
            location,
            up=up,
            ior=_GLASS,
            box_min=box[0],
            box_max=box[1],
            resolution=len(grid.distances),
            **options,
        )

    try:
        with fraction_bar("vessel") as progress:
            fit = fit_vessel(build, float(np.ptp(across, axis=0).max()), observations, progress, settings)
        lengths = {name: float(f"{length:.4g}") for name, length in fit.lengths.items()}
        liquid_ior = _WATER if "level" in lengths else 1.0
        vessel = build(liquid_ior=liquid_ior, **lengths)
    except NerfroError as error:
        warn(f"no vessel is fitted: {error}")
        return {}, None
    values = [
        f"{name} {value:.3g}" + ("" if name in fit.unknown else f" +- {fit.standard_errors[name]:.2g}")
        for name, value in fit.lengths.items()
    ]
    print(f"vessel, {'with a liquid' if liquid_ior > 1 else 'empty'}: {', '.join(values)}, height {vessel.height:.3g}")
    if fit.unknown:
        warn(f"typical values of {' and '.join(fit.unknown)} are kept, because the photographs do not determine them")
    return {"up": up, "ior": _GLASS, "liquid_ior": liquid_ior} | lengths, vessel


def fit_vessel(
    build: Callable[..., SdfVessel],
    width: float,
    observations: Observations,
    progress: Callable[[float], None] = lambda done: None,
    settings: VesselFitSettings = VesselFitSettings(),
) -> VesselFit:
    """Fit wall, foot, fillet and level of an open vessel.

    Args:
        build: constructor of the vessel, which takes the lengths and the index of the liquid.
        width: width of the outer surface, world units.
        observations: observations of the object and its surroundings.
        progress: called with the completed fraction.
        settings: typical lengths, candidates and limits.
    """
    settings.use()
    typical = {name: getattr(settings, name) * width for name in ("wall", "foot", "fillet")}
    widest = typical | {"fillet": settings.max_fillet * width}  # distances are exact up to this depth
    empty = build(**widest, liquid_ior=1.0)
    filled = build(**widest, liquid_ior=_WATER, level=0.5 * empty.height)
    work = 1 + len(settings.levels) + len(settings.rounds) * (len(typical) + 1) * settings.num_candidates
    search = ObjectErrors(observations, lambda count: progress(min(1.0, count / work)), settings.errors)
    levels: list[dict[str, float]] = [{}, *({"level": level * empty.height} for level in settings.levels)]
    errors = [search.of((filled if level else empty).with_lengths(typical | level)) for level in levels]
    best = int(np.argmin([search.mean(error) for error in errors]))
    vessel = filled if best and search.decreases(errors[0], errors[best], settings.num_errors) else empty
    typical |= levels[best] if vessel is filled else {}
    lengths, standard_errors = dict(typical), dict[str, float]()
    highest = settings.max_level * empty.height
    offsets = np.linspace(-1, 1, settings.num_candidates)
    for factor, fraction in settings.rounds:
        for name in typical:
            is_level = name == "level"
            half_width = fraction * empty.height if is_level else np.log(factor)
            middle = lengths[name] if is_level else np.log(lengths[name])
            grid = middle + half_width * offsets
            values = grid.clip(max=highest) if is_level else np.exp(grid)
            sums = np.stack([search.of(vessel.with_lengths(lengths | {name: value})) for value in values.tolist()])
            # Robust errors have narrow minima, which a quadratic function through all candidates would miss.
            minimum = parabola_minimum(grid, mean_errors(sums, search.counts))[0]
            minima = parabola_minimum(grid, mean_errors(sums, search.counts, search.samples))
            spread = float(standard_error(minima, search.counts))
            lengths[name] = float(min(minimum, highest) if is_level else np.exp(minimum))
            standard_errors[name] = spread if is_level else spread * lengths[name]
    unknown = [name for name in typical if standard_errors[name] > settings.max_standard_error * lengths[name]]
    progress(1.0)
    return VesselFit(lengths | {name: typical[name] for name in unknown}, standard_errors, unknown)
