"""Estimation of the refractive indices of bodies from the directions in which their rays leave.

For each candidate, rays through pixels of the object are traced, and the colours of the pixels are compared with the
known surroundings in the exit directions. The error has one wide valley around the true index, because exit directions
change slowly with the index. A ball of index n turns an exit direction by 2 tan(t) / n radians per unit of the index,
where t is the angle of refraction. For example, an index error of 0.01 at n = 1.5 turns a ray with an impact parameter
of half the radius by 0.27 degrees.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerfro.capture.grid_search import (
    MIN_VIEWS,
    Minimum,
    bootstrap_weights,
    mean_errors,
    quadratic_minimum,
    standard_error,
)
from nerfro.capture.preprocess_options import INDEX, Request, build_medium, index_settings
from nerfro.capture.surroundings import Observations, Pixels, Room, Surroundings, robust_scale
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import fraction_bar
from nerfro.core.robust import geman_mcclure, geman_mcclure_weight
from nerfro.files.atomic import write_atomically
from nerfro.media.base import Medium
from nerfro.media.solid import Solid, body_names
from nerfro.rendering.scene_file import Provenance
from nerfro.samplers.paths.snell import Snell

LOWEST, HIGHEST = 1.0, 2.5  # range of the search
_RANGE = HIGHEST - LOWEST


class _Plan(NamedTuple):
    """Sizes of the search grids. Radii are fractions of the range of the search."""

    coarse_steps: int  # candidates along each axis of the first grid
    coarse_pixels: int
    fine_steps: int
    fine_radii: tuple[float, ...]  # one for each refinement
    fine_pixels: int

    def num_rays(self, num_bodies: int) -> int:
        """Estimate the number of rays to trace."""
        fine = _TYPICAL_GRIDS * self.fine_steps**num_bodies * self.fine_pixels
        return self.coarse_steps**num_bodies * self.coarse_pixels + fine


# By number of bodies.
_PLANS = {1: _Plan(31, 12_000, 9, (1 / 30, 1 / 75), 60_000), 2: _Plan(13, 4_000, 5, (1 / 75, 1 / 75), 20_000)}
_NEAR_PIXELS = 12_000  # near surroundings are rendered for each ray, so fewer pixels are used
# Maximum number of grids of one radius, which follow the minimum, and typical number of grids, for the progress.
_MAX_GRIDS, _TYPICAL_GRIDS = 10, 4
# The indices of two bodies trade, so their valley is narrow. Grids are elongated along the valley by at most this
# factor. Finite differences at so many pixels, over this fraction of the range, determine the direction of the valley.
_MAX_ELONGATION, _SLOPE_PIXELS, _DIFFERENCE = 6.0, 6_000, 1 / 300
# Rays with more events, or more than two per surface, are left out: small errors of the surface turn them far.
_MAX_EVENTS = 4
# Limits of a reliable estimate: depth of the valley relative to the error of unrelated colours, standard error and
# distance from the ends of the search relative to the range, and fraction of the pixels with known surroundings.
_MIN_DEPTH, _MAX_STANDARD_ERROR, _MIN_DISTANCE_FROM_END, _MIN_KNOWN = 0.03, 0.02, 1 / 150, 0.1
_LOWEST_MATERIAL = 1.25  # ordinary liquids and solids have larger indices; that of ice is 1.31


@dataclass(frozen=True)
class Estimate:
    """Estimated refractive indices of K bodies in ascending order of priority.

    Attributes:
        names: names of the indices for messages.
        values: the indices.
        standard_errors: standard errors by resampling of the views, infinite for too few views; errors of the surface
            are not included.
        coarse: candidates of the first grid, with their mean robust errors in the last column: 0 for exact colours, 1
            for outliers.
        doubts: reasons why the photographs do not determine the indices; empty for a reliable estimate.
    """

    names: list[str]
    values: Float[np.ndarray, " indices"]
    standard_errors: Float[np.ndarray, " indices"]
    coarse: Float[np.ndarray, "candidates columns"]
    doubts: list[str]

    @property
    def written_errors(self) -> list[float | None]:
        """Standard errors for JSON files, which cannot contain infinite numbers."""
        return [round(error, 5) if np.isfinite(error) else None for error in self.standard_errors.tolist()]


def find_indices(
    medium: Solid, through: Pixels, surroundings: Surroundings, progress: Callable[[float], None] = lambda done: None
) -> Estimate:
    """Search the indices of one or two bodies from coarse to fine grids.

    Args:
        medium: the bodies; each receives one index for all wavelengths.
        through: pixels inside the silhouette of the object.
        surroundings: known surroundings.
        progress: called with the completed fraction.

    Raises:
        NerfroError: there are more than two bodies, or no ray of the pixels meets the medium.
    """
    num_bodies = len(medium.iors)
    if num_bodies not in _PLANS:
        raise NerfroError(
            f"the medium has {num_bodies} bodies, and at most two indices are searched for; set medium.ior= and "
            "medium.inner_iors=, or ior or material of each of bodies="
        )
    plan = _PLANS[num_bodies]
    if isinstance(surroundings.background, Room):
        plan = plan._replace(coarse_pixels=_NEAR_PIXELS // 4, fine_pixels=_NEAR_PIXELS)
    num_rays = plan.num_rays(num_bodies)
    search = _Search(
        medium, through.some(plan.fine_pixels), surroundings, lambda traced: progress(min(1, traced / num_rays))
    )
    coarse, coarse_errors = _coarse_search(search, plan, num_bodies)
    values, grid = _refine_minimum(search, plan, coarse[coarse_errors.argmin()])
    progress(1.0)
    names = ["index"] if num_bodies == 1 else [f"index of body {body + 1}" for body in range(num_bodies)]
    standard_errors = grid.standard_errors()
    doubts = _doubts(names, values, standard_errors, grid, search)
    return Estimate(names, values, standard_errors, np.column_stack([coarse, coarse_errors]), doubts)


def _coarse_search(
    search: _Search, plan: _Plan, num_bodies: int
) -> tuple[Float[np.ndarray, "candidates indices"], Float[np.ndarray, " candidates"]]:
    """Compute the mean errors of candidates over the whole range of the search."""
    candidates = 0.5 * (LOWEST + HIGHEST + _RANGE * _grid(plan.coarse_steps, num_bodies))
    return candidates, mean_errors(*search.errors(candidates, plan.coarse_pixels, False))[0]


class _FineGrid(NamedTuple):
    """Errors of a grid of candidates around the minimum.

    Attributes:
        candidates: points of the grid.
        axes: half axes of the grid, in columns.
        sums: sums of the errors by view.
        counts: number of pixels of each view.
    """

    candidates: Float[np.ndarray, "candidates indices"]
    axes: Float[np.ndarray, "indices indices"]
    sums: Float[np.ndarray, "candidates V"]
    counts: Float[np.ndarray, "V"]

    def minimum(self) -> Minimum:
        """Find the minimum of the mean errors."""
        return quadratic_minimum(self.candidates, mean_errors(self.sums, self.counts), self.axes)

    def standard_errors(self) -> Float[np.ndarray, " indices"]:
        """Estimate the standard errors of the minimum from random samples of the views."""
        errors = mean_errors(self.sums, self.counts, bootstrap_weights(self.counts))
        return standard_error(quadratic_minimum(self.candidates, errors, self.axes).values, self.counts)


def _refine_minimum(
    search: _Search, plan: _Plan, start: Float[np.ndarray, " indices"]
) -> tuple[Float[np.ndarray, " indices"], _FineGrid]:
    """Follow the minimum with grids of decreasing radius.

    Args:
        search: errors of candidates.
        plan: sizes of the grids.
        start: best candidate of the coarse search.

    Returns:
        The minimum, and the last grid.
    """
    offsets, values = _grid(plan.fine_steps, len(start)), start
    for radius in plan.fine_radii:
        num_pixels = plan.fine_pixels // (1 if radius == plan.fine_radii[-1] else 3)
        for _ in range(_MAX_GRIDS):
            axes = radius * _RANGE * search.valley(values)
            extent = np.abs(axes).sum(1)
            centre = values.clip(LOWEST + extent, HIGHEST - extent)
            candidates = centre + offsets @ axes.T
            grid = _FineGrid(candidates, axes, *search.errors(candidates, num_pixels, True))
            minimum = grid.minimum().values[0]
            values = minimum.clip(LOWEST, HIGHEST)
            if (np.abs(np.linalg.solve(axes, minimum - centre)) < 0.5).all():
                break
    return values, grid


def _grid(steps: int, num_axes: int) -> Float[np.ndarray, "candidates indices"]:
    """Return the points of a regular grid in [-1, 1]^n, with n indices."""
    return np.array(list(itertools.product(np.linspace(-1, 1, steps), repeat=num_axes)))


def _doubts(
    names: list[str],
    values: Float[np.ndarray, " indices"],
    standard_errors: Float[np.ndarray, " indices"],
    grid: _FineGrid,
    search: _Search,
) -> list[str]:
    """List the reasons why the photographs do not determine the indices."""
    depth = 1 - float(mean_errors(grid.sums, grid.counts).min()) / search.unrelated
    known, num_views = grid.counts.sum() / search.num_pixels, np.count_nonzero(grid.counts)
    # Without a valley, the spread of the minima does not show whether the views agree.
    standard_errors = np.where(grid.minimum().curvatures[0] > 0, standard_errors, np.inf)
    doubts = []
    if known < _MIN_KNOWN:
        doubts.append(f"for {1 - known:.0%} of the object's pixels no photograph shows the origin of the light")
    if depth < _MIN_DEPTH:
        doubts.append(
            f"the best {' and '.join(names)} reduces the error of unrelated colours by only {max(0.0, depth):.1%}: the "
            "object may be opaque, or the surroundings are unknown in the exit directions"
        )
    end = _MIN_DISTANCE_FROM_END * _RANGE
    for name, value, error in zip(names, values, standard_errors, strict=True):
        if not LOWEST + end < value < HIGHEST - end:
            doubts.append(f"the {name} is at an end of the search range, {LOWEST:.4g} to {HIGHEST:.4g}")
        elif _MAX_STANDARD_ERROR * _RANGE < error < np.inf:
            doubts.append(f"the {name} has a standard error of {error:.2g}: the views do not agree")
    if LOWEST + end < values[0] < _LOWEST_MATERIAL:
        doubts.append(f"no liquid or solid has an index of {values[0]:.3g}: the object may be opaque or hollow")
    if num_views < MIN_VIEWS:
        doubts.append(f"{num_views} views are too few for a standard error; photograph from more sides")
    return doubts


class _Search:
    """Errors of candidate indices at pixels of the object; `progress` is called with the number of traced rays."""

    def __init__(
        self, medium: Solid, through: Pixels, surroundings: Surroundings, progress: Callable[[int], None]
    ) -> None:
        self._achromatic, self._surroundings = medium.achromatic(), surroundings
        self._progress, self._num_traced = progress, 0
        medium = self._achromatic.with_indices(torch.full_like(medium.iors, 0.5 * (LOWEST + HIGHEST)))
        self._sampler = Snell(max_events=max(_MAX_EVENTS, 2 * len(medium.iors)))
        self._pixels = through[self._sampler(through.rays, medium).refracted]
        self.num_pixels = len(self._pixels)
        if not self.num_pixels:
            raise NerfroError(
                "no ray of the object's pixels meets the surface; check that mesh, masks and poses belong together"
            )
        colours = surroundings.colours
        self._scale = robust_scale(surroundings)
        other = colours[torch.randint(len(colours), (len(self._pixels),), generator=torch.Generator().manual_seed(1))]
        self.unrelated = float(geman_mcclure(other - self._pixels.radiance, self._scale).mean())

    def valley(self, values: Float[np.ndarray, " indices"]) -> Float[np.ndarray, "indices indices"]:
        """Return directions across and along the valley of the error, in columns, elongated along the valley.

        The directions are the eigenvectors of the Gauss-Newton matrix of the robust residuals. For one index the
        result is 1.
        """
        count = len(values)
        if count == 1:
            return np.eye(count)
        pixels = self._pixels.some(_SLOPE_PIXELS)
        residuals, known = self._residuals(pixels, values)
        slopes = []
        for offset in _DIFFERENCE * _RANGE * np.eye(count):
            (after, known_after), (before, known_before) = (
                self._residuals(pixels, values + each) for each in (offset, -offset)
            )
            slopes.append(after - before)
            known &= known_after & known_before
        weights = geman_mcclure_weight(residuals, self._scale)
        jacobian = torch.stack(slopes, -1)[known].double()
        products = torch.einsum("p,pci,pcj->ij", weights[known].double(), jacobian, jacobian).numpy()
        eigenvalues, directions = np.linalg.eigh(products)
        if not eigenvalues.max() > 0:  # the surroundings are unknown for all pixels
            return np.eye(count)
        ratio = eigenvalues.max() / eigenvalues.clip(1e-9 * eigenvalues.max())
        return directions * np.sqrt(ratio).clip(max=_MAX_ELONGATION)

    def _residuals(
        self, pixels: Pixels, values: Float[np.ndarray, " indices"]
    ) -> tuple[Float[torch.Tensor, "Q 3"], Bool[torch.Tensor, "Q"]]:
        """Compute the residuals of pixels for one candidate, and whether the residuals are known."""
        medium = self._achromatic.with_indices(torch.from_numpy(values.clip(LOWEST, HIGHEST)))
        trace = self._sampler.trace(pixels.rays, medium)
        radiance, known = self._surroundings.radiance(trace.path.exits())
        return radiance - pixels.radiance, known & ~trace.exceeded

    def errors(
        self, candidates: Float[np.ndarray, "candidates indices"], num_pixels: int, common: bool
    ) -> tuple[Float[np.ndarray, "candidates V"], Float[np.ndarray, "V"]]:
        """Sum the robust errors of candidates over the pixels of each view.

        Args:
            candidates: indices of the bodies.
            num_pixels: maximum number of pixels.
            common: use only pixels whose surroundings are known for all candidates, because similar candidates would
                otherwise be preferred for more known pixels. If false, pixels with unknown surroundings have the error
                of unrelated colours.

        Returns:
            Sums of the errors, and number of pixels of each view.
        """
        pixels = self._pixels.some(num_pixels)
        errors, known_for_all = [], torch.ones(len(pixels), dtype=torch.bool)
        for values in candidates:
            residuals, known = self._residuals(pixels, values)
            known_for_all &= known
            errors.append(torch.where(known, geman_mcclure(residuals, self._scale), self.unrelated))
            self._num_traced += len(pixels)
            self._progress(self._num_traced)
        used = known_for_all if common else torch.ones_like(known_for_all)
        view, num_views = pixels.view[used], len(pixels.cameras)
        sums = [torch.bincount(view, error[used].double(), num_views).numpy() for error in errors]
        return np.stack(sums), torch.bincount(view, minlength=num_views).double().numpy()


@dataclass(frozen=True)
class FoundMedium:
    """A medium with all indices.

    Attributes:
        medium: the medium.
        estimate: the indices that were searched; None if they are known.
        index_settings: settings of the medium for these indices.
    """

    medium: Medium
    estimate: Estimate | None = None
    index_settings: dict[str, object] = field(default_factory=dict)

    @property
    def provenance(self) -> Provenance:
        """Accuracy of the indices, for the scene file."""
        if self.estimate is None:
            return Provenance()
        return Provenance(standard_error=self.estimate.written_errors, doubts=self.estimate.doubts)

    @property
    def is_doubtful(self) -> bool:
        """Whether the photographs do not determine the indices."""
        return self.estimate is not None and bool(self.estimate.doubts)


def initial_medium(request: Request, location: str, settings: dict[str, object]) -> Medium:
    """Build the medium with a surface; the indices are 1.5 unless they are given.

    Args:
        request: options of the command.
        location: file of the surface.
        settings: settings of the medium for the surface (see `surface_settings`).
    """
    config, settings = request.config.medium, settings | {"mesh": location}
    if request.searches_index:
        names = [*(config.get("bodies") or body_names(1 + len(config.get("inner_meshes", []))))]
        settings |= index_settings(config, names, [1.5] * len(names))
    return build_medium(request, settings)


def find_medium(request: Request, observations: Observations, medium: Medium) -> FoundMedium:
    """Search the indices of a medium if they are not given.

    Args:
        request: options of the command.
        observations: observations of the object and its surroundings, relative to the origin of the medium.
        medium: see `initial_medium`.
    """
    if not request.searches_index:
        return FoundMedium(medium)
    if not isinstance(medium, Solid):
        raise NerfroError("the index of this type of medium cannot be searched for; set medium.ior=, or medium=object")
    found = _search_index(observations, medium, request.folder)
    searched = medium.with_indices(torch.from_numpy(found.values))
    return FoundMedium(searched, found, index_settings(request.config.medium, medium.names, found.values))


def _search_index(observations: Observations, medium: Solid, folder: Path) -> Estimate:
    """Search the indices of the bodies of a medium, print the result, and write index.json.

    Args:
        observations: observations of the object and its surroundings.
        medium: the bodies.
        folder: output folder.
    """
    through, surroundings = observations.through, observations.surroundings
    with fraction_bar("search") as progress:
        found = find_indices(medium, through, surroundings, progress)
    for name, value, error in zip(found.names, found.values, found.standard_errors, strict=True):
        # At an end of the search range, all samples of the views have the same minimum.
        spread = f" +- {error:.2g} (standard error by resampling of the views)" if 0 < error < np.inf else ""
        print(f"{name}: {value:.5g}{spread}")
    for doubt in found.doubts:
        warn(f"the photographs do not determine the {' and '.join(found.names)}: {doubt}")
    values = [round(value, 5) for value in found.values.tolist()]
    figures = {"ior": values, "standard_error": found.written_errors, "doubts": found.doubts}
    write_atomically(folder / INDEX, json.dumps(figures, indent=1) + "\n")
    return found
