"""Fit of the lengths of an open drinking glass to photographs.

Rays through pixels of the object are traced with all reflections, and the colours of the pixels are compared with the
known surroundings in the exit directions. A thin wall hardly bends rays, so that most of the information comes from
reflections, the foot and the liquid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfro.capture.grid_search import mean_errors, parabola_minimum, standard_error
from nerfro.capture.object_errors import COMMON_INDICES, ObjectErrors
from nerfro.capture.surroundings import Observations
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import fraction_bar
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.vessel import SdfVessel
from nerfro.silhouettes.upright import find_up

# Lengths of a typical glass, as fractions of its width.
_TYPICAL = {"wall": 0.02, "foot": 0.06, "fillet": 0.1}
_MAX_FILLET = 0.4
_GLASS, _WATER = COMMON_INDICES["glass"], COMMON_INDICES["water"]
# Levels of a liquid that are compared with an empty glass, as fractions of the height.
_LEVELS = (0.3, 0.5, 0.7, 0.9)
_MAX_LEVEL = 0.999  # fraction of the height; a level of four digits stays below the height
# Half width of the grid of candidates of each round: a factor for lengths, and a fraction of the height for the level.
_ROUNDS = ((2.0, 0.1), (1.5, 0.06), (1.5, 0.03))
_GRID = np.linspace(-1, 1, 5)
# A vessel contains a liquid if the liquid decreases the error by this number of standard errors.
_SIGNIFICANT = 2.0
# Largest standard error of a known length, relative to the length; the last grid limits the error to about 0.4.
_MAX_STANDARD_ERROR = 0.2


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
    medium: SdfGrid, location: str, mesh: TriangleMesh, observations: Observations
) -> tuple[dict[str, object], SdfVessel | None]:
    """Fit a vessel to the photographs, print its lengths, and return the settings of the medium, and the medium.

    Args:
        medium: solid body with the outer surface.
        location: file of the outer surface.
        mesh: the outer surface.
        observations: observations of the object and its surroundings.

    Returns:
        Settings of the vessel except its mesh, and the vessel; none if the surface leaves no cavity.
    """
    found_up = find_up(observations.views.cameras, mesh)
    up = [0.0, 0.0, 1.0] if found_up is None else [round(float(x), 4) for x in found_up[0]]
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
            fit = fit_vessel(build, float(np.ptp(across, axis=0).max()), observations, progress)
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
) -> VesselFit:
    """Fit wall, foot, fillet and level of an open vessel.

    Args:
        build: constructor of the vessel, which takes the lengths and the index of the liquid.
        width: width of the outer surface, world units.
        observations: observations of the object and its surroundings.
        progress: called with the completed fraction.
    """
    typical = {name: fraction * width for name, fraction in _TYPICAL.items()}
    widest = typical | {"fillet": _MAX_FILLET * width}  # distances are exact up to this depth
    empty = build(**widest, liquid_ior=1.0)
    filled = build(**widest, liquid_ior=_WATER, level=0.5 * empty.height)
    work = 1 + len(_LEVELS) + len(_ROUNDS) * (len(typical) + 1) * len(_GRID)
    search = ObjectErrors(observations, lambda count: progress(min(1.0, count / work)))
    levels: list[dict[str, float]] = [{}, *({"level": level * empty.height} for level in _LEVELS)]
    errors = [search.of((filled if level else empty).with_lengths(typical | level)) for level in levels]
    best = int(np.argmin([search.mean(each) for each in errors]))
    vessel = filled if best and search.decreases(errors[0], errors[best], _SIGNIFICANT) else empty
    typical |= levels[best] if vessel is filled else {}
    lengths, standard_errors = dict(typical), dict[str, float]()
    highest = _MAX_LEVEL * empty.height
    for factor, fraction in _ROUNDS:
        for name in typical:
            is_level = name == "level"
            half_width = fraction * empty.height if is_level else np.log(factor)
            middle = lengths[name] if is_level else np.log(lengths[name])
            grid = middle + half_width * _GRID
            values = grid.clip(max=highest) if is_level else np.exp(grid)
            sums = np.stack([search.of(vessel.with_lengths(lengths | {name: value})) for value in values.tolist()])
            # Robust errors have narrow minima, which a quadratic function through all candidates would miss.
            found = parabola_minimum(grid, mean_errors(sums, search.counts))[0]
            minima = parabola_minimum(grid, mean_errors(sums, search.counts, search.samples))
            spread = float(standard_error(minima, search.counts))
            lengths[name] = float(min(found, highest) if is_level else np.exp(found))
            standard_errors[name] = spread if is_level else spread * lengths[name]
    unknown = [name for name in typical if standard_errors[name] > _MAX_STANDARD_ERROR * lengths[name]]
    progress(1.0)
    return VesselFit(lengths | {name: typical[name] for name in unknown}, standard_errors, unknown)
