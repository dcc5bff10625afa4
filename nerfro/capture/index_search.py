"""Estimation of the refractive indices of bodies from the directions in which their rays leave.

For each candidate, rays through pixels of the object are traced, and the colours of the pixels are compared with the
known surroundings in the exit directions. The error has one wide valley around the true index, because exit directions
change slowly with the index. A ball of index n turns an exit direction by 2 tan(t) / n radians per unit of the index,
where t is the angle of refraction. For example, an index error of 0.01 at n = 1.5 turns a ray with an impact parameter
of half the radius by 0.27 degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerfro.capture.object_errors import MIN_VIEWS, bootstrap_weights, mean_errors, quadratic_minimum, standard_error
from nerfro.capture.preprocess_options import INDEX, Request, index_settings
from nerfro.capture.surroundings import Observations, Pixels, Room, Surroundings, robust_scale
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import counting_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.robust import geman_mcclure, geman_mcclure_weight
from nerfro.files.atomic import write_json
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import expanded
from nerfro.registry.allowed import plain
from nerfro.registry.registration import build
from nerfro.rendering.scene_file import Provenance
from nerfro.samplers.paths.snell import Snell


class SearchPlan(NamedTuple):
    """Sizes of the search grids. Radii are fractions of the range of the search."""

    coarse_steps: int  # candidates along each axis of the first grid
    coarse_pixels: int
    fine_steps: int
    fine_radii: tuple[float, ...]  # one for each refinement
    fine_pixels: int


@dataclass(frozen=True)
class IndexSettings(AlgorithmSettings):
    """Settings of the index search (`find_indices`).

    Attributes:
        lowest, highest: range of the search.
        plans: sizes of the grids for one body and for two.
        near_pixels: number of pixels for near surroundings, which are rendered for each ray.
        max_grids: largest number of grids of one radius, which follow the minimum.
        typical_grids: typical number of these grids, for the progress.
        max_elongation: largest elongation of the grid along the valley of two bodies, whose indices trade.
        slope_pixels: number of pixels that determine the direction of the valley.
        difference: finite difference for this direction, as a fraction of the range.
        max_events: rays with more events, and more than two per surface, are left out: small errors of the surface turn
            them far.
        min_depth: smallest depth of the valley of a reliable estimate, relative to the error of unrelated colours.
        max_standard_error: largest standard error of a reliable estimate, as a fraction of the range.
        min_distance_from_end: smallest distance of a reliable estimate from the ends of the range, as a fraction.
        min_known: smallest fraction of the pixels with known surroundings.
        lowest_material: index that all ordinary liquids and solids exceed; that of ice is 1.31.
    """

    lowest: float = 1.0
    highest: float = 2.5
    plans: tuple[SearchPlan, ...] = field(
        default=(
            SearchPlan(31, 12_000, 9, (1 / 30, 1 / 75), 60_000),
            SearchPlan(13, 4_000, 5, (1 / 75, 1 / 75), 20_000),
        )
    )
    near_pixels: int = 12_000
    max_grids: int = 10
    typical_grids: int = 4
    max_elongation: float = 6.0
    slope_pixels: int = 6_000
    difference: float = 1 / 300
    max_events: int = 4
    min_depth: float = 0.03
    max_standard_error: float = 0.02
    min_distance_from_end: float = 1 / 150
    min_known: float = 0.1
    lowest_material: float = 1.25

    @property
    def range(self) -> float:
        """Width of the range of the search."""
        return self.highest - self.lowest

    def num_rays(self, plan: SearchPlan, num_bodies: int) -> int:
        """Estimate the number of rays to trace."""
        fine = self.typical_grids * plan.fine_steps**num_bodies * plan.fine_pixels
        return plan.coarse_steps**num_bodies * plan.coarse_pixels + fine


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
    medium: Bodies, through: Pixels, surroundings: Surroundings, settings: IndexSettings = IndexSettings()
) -> Estimate:
    """Search the indices of one or two bodies from coarse to fine grids.

    Args:
        medium: the bodies; each receives one index for all wavelengths.
        through: pixels inside the silhouette of the object.
        surroundings: known surroundings.
        settings: range, grids and limits.

    Returns:
        The indices, their accuracy, and doubts about them.

    Raises:
        NerfroError: there are more than two bodies, or no ray of the pixels meets the medium.
    """
    settings.use()
    num_bodies = len(medium.iors)
    if not 0 < num_bodies <= len(settings.plans):
        raise NerfroError(
            f"the medium has {num_bodies} bodies, and at most two indices are searched for; set medium.ior=, or ior "
            "or material of each of bodies="
        )
    plan = settings.plans[num_bodies - 1]
    if isinstance(surroundings.background, Room):
        plan = plan._replace(coarse_pixels=settings.near_pixels // 4, fine_pixels=settings.near_pixels)
    offsets = settings.range * _grid(plan.coarse_steps, num_bodies)
    coarse = 0.5 * (settings.lowest + settings.highest + offsets)
    with counting_bar("search", settings.num_rays(plan, num_bodies)) as advance:
        search = _Search(medium, through.some(plan.fine_pixels), surroundings, advance, settings)
        coarse_errors = mean_errors(*search.errors(coarse, plan.coarse_pixels, False))[0]
        values, grid = _refine_minimum(search, plan, coarse[coarse_errors.argmin()])
    names = ["index"] if num_bodies == 1 else [f"index of body {body + 1}" for body in range(num_bodies)]
    standard_errors = standard_error(grid.minima(bootstrap_weights(grid.counts))[0], grid.counts)
    doubts = _doubts(names, values, standard_errors, grid, search)
    return Estimate(names, values, standard_errors, np.column_stack([coarse, coarse_errors]), doubts)


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

    def minima(
        self, weights: Float[np.ndarray, "resamples V"] | int = 1
    ) -> tuple[Float[np.ndarray, "resamples indices"], Float[np.ndarray, "resamples indices"]]:
        """Find the minima of the mean errors for weightings of the views, see `quadratic_minimum`."""
        return quadratic_minimum(self.candidates, mean_errors(self.sums, self.counts, weights), self.axes)


def _refine_minimum(
    search: _Search, plan: SearchPlan, start: Float[np.ndarray, " indices"]
) -> tuple[Float[np.ndarray, " indices"], _FineGrid]:
    """Follow the minimum with grids of decreasing radius.

    Args:
        search: errors of candidates.
        plan: sizes of the grids.
        start: best candidate of the coarse search.

    Returns:
        The minimum, and the last grid.
    """
    settings, offsets, values = search.settings, _grid(plan.fine_steps, len(start)), start
    for radius in plan.fine_radii:
        num_pixels = plan.fine_pixels // (1 if radius == plan.fine_radii[-1] else 3)
        candidates = np.empty(0)
        for _ in range(settings.max_grids):
            axes = radius * settings.range * search.valley(values)
            extent = np.abs(axes).sum(1)
            centre = values.clip(settings.lowest + extent, settings.highest - extent)
            previous, candidates = candidates, centre + offsets @ axes.T
            if np.array_equal(previous, candidates):  # at an end of the range
                break
            grid = _FineGrid(candidates, axes, *search.errors(candidates, num_pixels, True))
            minimum = grid.minima()[0][0]
            values = minimum.clip(settings.lowest, settings.highest)
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
    settings, low, high = search.settings, search.settings.lowest, search.settings.highest
    known_fraction, num_views = grid.counts.sum() / search.num_pixels, np.count_nonzero(grid.counts)
    # Without a valley, the spread of the minima does not show whether the views agree.
    standard_errors = np.where(grid.minima()[1][0] > 0, standard_errors, np.inf)
    doubts = []
    if known_fraction < settings.min_known:
        doubts.append(
            f"for {1 - known_fraction:.0%} of the object's pixels no photograph shows the origin of the light"
        )
    if depth < settings.min_depth:
        doubts.append(
            f"the best {' and '.join(names)} reduces the error of unrelated colours by only {max(0.0, depth):.1%}: the "
            "object may be opaque, or the surroundings are unknown in the exit directions"
        )
    end = settings.min_distance_from_end * settings.range
    for name, value, error in zip(names, values, standard_errors, strict=True):
        if not low + end < value < high - end:
            doubts.append(f"the {name} is at an end of the search range, {low:.4g} to {high:.4g}")
        elif settings.max_standard_error * settings.range < error < np.inf:
            doubts.append(f"the {name} has a standard error of {error:.2g}: the views do not agree")
    if low + end < values[0] < settings.lowest_material:
        doubts.append(f"no liquid or solid has an index of {values[0]:.3g}: the object may be opaque or hollow")
    if num_views < MIN_VIEWS:
        doubts.append(f"{num_views} views are too few for a standard error; photograph from more sides")
    return doubts


class _Search:
    """Errors of candidate indices at pixels of the object; `advance` is called with numbers of traced rays."""

    def __init__(
        self,
        medium: Bodies,
        through: Pixels,
        surroundings: Surroundings,
        advance: Callable[[int], None],
        settings: IndexSettings,
    ) -> None:
        self.settings = settings
        self._achromatic, self._surroundings, self._advance = medium.achromatic(), surroundings, advance
        medium = self._achromatic.with_indices(torch.full_like(medium.iors, 0.5 * (settings.lowest + settings.highest)))
        self._sampler = Snell(max_events=max(settings.max_events, 2 * len(medium.iors)))
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
        count, settings = len(values), self.settings
        if count == 1:
            return np.eye(count)
        pixels = self._pixels.some(settings.slope_pixels)
        residuals, usable = self._residuals(pixels, values)
        slopes = []
        for offset in settings.difference * settings.range * np.eye(count):
            after, usable_after = self._residuals(pixels, values + offset)
            before, usable_before = self._residuals(pixels, values - offset)
            slopes.append(after - before)
            usable &= usable_after & usable_before
        weights = geman_mcclure_weight(residuals, self._scale)
        jacobian = torch.stack(slopes, -1)[usable].double()
        products = torch.einsum("p,pci,pcj->ij", weights[usable].double(), jacobian, jacobian).numpy()
        eigenvalues, directions = np.linalg.eigh(products)
        if not eigenvalues.max() > 0:  # the surroundings are unknown for all pixels
            return np.eye(count)
        ratio = eigenvalues.max() / eigenvalues.clip(1e-9 * eigenvalues.max())
        return directions * np.sqrt(ratio).clip(max=settings.max_elongation)

    def _residuals(
        self, pixels: Pixels, values: Float[np.ndarray, " indices"]
    ) -> tuple[Float[torch.Tensor, "Q 3"], Bool[torch.Tensor, "Q"]]:
        """Compute the residuals of pixels for one candidate, and whether the residuals are known."""
        values = values.clip(self.settings.lowest, self.settings.highest)
        medium = self._achromatic.with_indices(torch.from_numpy(values))
        trace = self._sampler.trace(pixels.rays, medium)
        exits = trace.path.in_room_of(pixels.rays).exits()
        radiance, known = self._surroundings.radiance(exits).clamp(max=1), self._surroundings.known(exits)
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
        errors, usable_for_all = [], torch.ones(len(pixels), dtype=torch.bool)
        for values in candidates:
            residuals, usable = self._residuals(pixels, values)
            usable_for_all &= usable
            errors.append(torch.where(usable, geman_mcclure(residuals, self._scale), self.unrelated))
            self._advance(len(pixels))
        used = usable_for_all if common else torch.ones_like(usable_for_all)
        view, num_views = pixels.view[used], len(pixels.cameras)
        sums = [torch.bincount(view, error[used].double(), num_views).numpy() for error in errors]
        return np.stack(sums), torch.bincount(view, minlength=num_views).double().numpy()


@dataclass(frozen=True)
class FoundMedium:
    """A medium with all indices.

    Attributes:
        medium: the medium.
        provenance: accuracy of the indices that were searched, for the scene file.
        index_settings: settings of the medium for these indices; empty if the indices are known.
    """

    medium: Medium
    provenance: Provenance = field(default_factory=Provenance)
    index_settings: dict[str, object] = field(default_factory=dict)


def initial_medium(request: Request, location: str, settings: dict[str, object]) -> Medium:
    """Build the medium with a surface, so that an unsuitable surface is refused; the indices are 1.5 unless given.

    Args:
        request: options of the command.
        location: file of the surface.
        settings: settings of the medium for the surface (see `surface_settings`).
    """
    config, settings = request.config.medium, settings | {"mesh": location}
    if request.searches_index:
        names = [*expanded({name: config.get(name) for name in ("mesh", "bodies")} | settings)]
        settings |= index_settings(config, names, [1.5] * len(names))
    medium: Medium = build(plain(config) | settings)
    return medium


def find_medium(request: Request, observations: Observations, medium: Medium) -> FoundMedium:
    """Search the indices of a medium if they are not given, print the result, and write index.json.

    Args:
        request: options of the command.
        observations: observations of the object and its surroundings, relative to the origin of the medium.
        medium: see `initial_medium`.
    """
    if not request.searches_index:
        return FoundMedium(medium)
    bodies = medium.bodies
    if bodies is None:
        raise NerfroError("the index of this type of medium cannot be searched for; set medium.ior=, or medium=object")
    estimate = find_indices(bodies, observations.through, observations.surroundings)
    for name, value, error in zip(estimate.names, estimate.values, estimate.standard_errors, strict=True):
        # At an end of the search range, all samples of the views have the same minimum.
        spread = f" +- {error:.2g} (standard error by resampling of the views)" if 0 < error < np.inf else ""
        print(f"{name}: {value:.5g}{spread}")
    for doubt in estimate.doubts:
        warn(f"the photographs do not determine the {' and '.join(estimate.names)}: {doubt}")
    origin = Provenance(standard_error=estimate.written_errors, doubts=estimate.doubts)
    values = [round(value, 5) for value in estimate.values.tolist()]
    figures = {"ior": values, "standard_error": origin.standard_error, "doubts": origin.doubts}
    write_json(request.out / INDEX, figures)
    searched = bodies.with_indices(torch.from_numpy(estimate.values))
    settings = index_settings(request.config.medium, bodies.names, estimate.values)
    return FoundMedium(searched, origin, settings)
