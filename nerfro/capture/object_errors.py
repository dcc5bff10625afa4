"""Errors of candidates at pixels of a photographed object, against the known surroundings.

The errors of each candidate are summed by view, so that random samples of the views give standard errors (bootstrap).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Num
from torch import Tensor

from nerfro.capture.surroundings import Observations, recorded_and_clipped, recorded_radiance, robust_scale
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.robust import geman_mcclure
from nerfro.core.types import Path
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.snell import Snell

MIN_VIEWS = 5  # with pixels, for a standard error: resampling of fewer views underestimates the error
# Indices of water and of soda-lime glass, for photographs that do not determine the index.
COMMON_INDICES = {"water": 1.333, "glass": 1.52}
STRAIGHT, SOLID, VESSEL = "straight rays", "solid body", "vessel"


def bootstrap_weights(counts: Float[np.ndarray, "V"], num_samples: int = 200) -> Float[np.ndarray, "resamples V"]:
    """Return how often each view is drawn in random samples of the views with pixels."""
    num_views = int(np.count_nonzero(counts))
    drawn = np.random.default_rng(0).multinomial(num_views, (counts > 0) / max(1, num_views), num_samples)
    return drawn.astype(np.float64)


def standard_error(
    samples: Float[np.ndarray, " resamples *indices"], counts: Float[np.ndarray, "V"]
) -> Float[np.ndarray, "*indices"]:
    """Compute the standard deviation of estimates from random samples of the views; infinite for too few views."""
    return np.where(np.count_nonzero(counts) < MIN_VIEWS, np.inf, samples.std(0))


def mean_errors(
    sums: Float[np.ndarray, "candidates V"],
    counts: Float[np.ndarray, "V"],
    weights: Num[np.ndarray, "resamples V"] | int = 1,
) -> Float[np.ndarray, "resamples candidates"]:
    """Average errors that are summed by view over all pixels, optionally for several weightings of the views."""
    weights = np.atleast_2d(weights * np.ones_like(counts))
    return (weights @ sums.T) / (weights @ counts)[:, None].clip(1)


def quadratic_minimum(
    candidates: Float[np.ndarray, "candidates indices"],
    errors: Float[np.ndarray, "resamples candidates"],
    axes: Float[np.ndarray, "indices indices"],
    max_extrapolation: float = 1.5,
) -> tuple[Float[np.ndarray, "resamples indices"], Float[np.ndarray, "resamples indices"]]:
    """Fit a quadratic function to the errors of all candidates by least squares, and find its minimum.

    Args:
        candidates: points of the grid.
        errors: one set of errors for each weighting.
        axes: half axes of the grid, in columns.
        max_extrapolation: largest distance of the minimum from the centre of the grid, relative to the half axes.

    Returns:
        The minima, or the best candidates for functions without a minimum near the grid; and the second derivatives of
        the functions by each index.
    """
    count, centre = candidates.shape[1], candidates.mean(0)
    inverse = np.linalg.inv(axes)
    x = (candidates - centre) @ inverse.T
    pairs = list(itertools.combinations_with_replacement(range(count), 2))
    terms = np.stack([np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)], 1)
    coefficients = errors @ np.linalg.pinv(terms).T
    hessian = np.zeros((len(errors), count, count))
    for (i, j), coefficient in zip(pairs, coefficients[:, 1 + count :].T, strict=True):
        hessian[:, i, j] += coefficient
        hessian[:, j, i] += coefficient
    convex = np.linalg.eigvalsh(hessian)[:, 0] > 1e-9
    invertible = np.where(convex[:, None, None], hessian, np.eye(count))
    minimum = -np.linalg.solve(invertible, coefficients[:, 1 : 1 + count, None])[..., 0]
    near = convex & (np.abs(minimum).max(1) < max_extrapolation)
    minimum = np.where(near[:, None], minimum, x[errors.argmin(1)])
    return centre + minimum @ axes.T, np.diagonal(inverse.T @ hessian @ inverse, axis1=1, axis2=2)


def parabola_minimum(
    grid: Float[np.ndarray, " candidates"], errors: Float[np.ndarray, "resamples candidates"]
) -> Float[np.ndarray, " resamples"]:
    """Find the minima of the parabolas through the best candidate and its two neighbours.

    `quadratic_minimum` averages the noise of all candidates, but misses a minimum that is narrower than the grid. This
    function is for coarse grids of one quantity.

    Args:
        grid: evenly spaced candidates, at least three.
        errors: one set of errors for each weighting.

    Returns:
        The minima, at most one step of the grid from the best candidate.
    """
    lowest = errors.argmin(1).clip(1, len(grid) - 2)
    before, at, after = (errors[np.arange(len(errors)), lowest + offset] for offset in (-1, 0, 1))
    curvature = before - 2 * at + after
    offset = 0.5 * (before - after) / np.where(curvature > 0, curvature, 1)
    offset = np.where(curvature > 0, offset.clip(-1, 1), np.sign(before - after))
    return grid[lowest] + offset * (grid[1] - grid[0])


@dataclass(frozen=True)
class ObjectErrorSettings(AlgorithmSettings):
    """Settings of the errors at pixels of the object, and of the support of bodies (`unsupported_bodies`).

    On the real glass of water, the errors of the solid body and of the vessel differ by 0.014 in the wrong order, and
    both decrease the error by 0.25 (docs/lab/simulated_glassware.md).

    Attributes:
        num_pixels: number of pixels.
        min_weight: smallest weight of a reflected or refracted path.
        num_errors: a supported body decreases the error of straight rays, and a reflection or absorption that of the
            body without it, by at least this number of standard errors.
        min_gain: smallest decrease of a supported body, as a fraction of the decrease of the best body.
        initial_depth, max_depth: initial and largest optical depth of the mean path.
        initial_excess: initial excess of the radiance of clipped surroundings over 1, linear radiance.
        light_steps, light_rate: number of steps of Adam that fit both, and initial rate of their logarithms.
        min_share: smallest share of absorbed light that is reported.
    """

    num_pixels: int = 6000
    min_weight: float = 0.02
    num_errors: float = 3.0
    min_gain: float = 0.75
    initial_depth: float = 0.3
    max_depth: float = 3.0
    initial_excess: float = 0.3
    light_steps: int = 150
    light_rate: float = 0.1
    min_share: float = 0.05


@dataclass(frozen=True)
class ObservedLight:
    """Light of the surroundings that reaches the camera through an object.

    Attributes:
        absorption: absorption coefficients of the bodies for red, green and blue, per world unit; 0 for air.
        length: mean length within absorbing bodies of rays that cross them, world units.
        clipped_radiance: linear radiance of the surroundings where photographs are clipped, see `Surroundings`.
        reflects: whether partial reflection explains the pixels better than none.
    """

    absorption: Float[Tensor, "K 3"]
    length: float
    clipped_radiance: Float[Tensor, "3"]
    reflects: bool = False

    @property
    def absorbed(self) -> list[float]:
        """Shares of red, green and blue light that are absorbed along the mean path."""
        return [round(share, 2) for share in (-torch.expm1(-self.absorption.amax(0) * self.length)).tolist()]


class ObjectErrors:
    """Errors of the surroundings in the exit directions of rays through pixels of the object.

    Args:
        observations: observations of the object and its surroundings.
        advance: called once for each body.
        settings: number of pixels, and smallest weight.
        branches: reflections that are followed, see `Snell`.
    """

    def __init__(
        self,
        observations: Observations,
        advance: Callable[[], None] = lambda: None,
        settings: ObjectErrorSettings = ObjectErrorSettings(),
        branches: Literal["none", "all"] = "all",
    ) -> None:
        settings.use()
        self._settings, self._surroundings = settings, observations.surroundings
        self._pixels = observations.through.some(settings.num_pixels)
        self._scale = robust_scale(self._surroundings)
        self._sampler = Snell(branches=branches, least_weight=settings.min_weight)
        self._advance = advance
        self.counts = np.bincount(self._pixels.view, minlength=len(self._pixels.cameras)).astype(np.float64)
        self.samples = bootstrap_weights(self.counts)

    def of(self, body: Medium) -> Float[np.ndarray, "V"]:
        """Sum the robust errors over the pixels of each view."""
        radiance = recorded_radiance(self._path(body), self._surroundings.radiance)
        self._advance()
        return self._sums(radiance - self._pixels.radiance)

    def fit_light(self, body: Bodies, absorbs: Sequence[bool]) -> list[tuple[ObservedLight, Float[np.ndarray, "3 V"]]]:
        """Fit absorption coefficients and the radiance of clipped surroundings by gradient descent, with fixed paths.

        Args:
            body: the bodies. Those of index 1 are air.
            absorbs: for each fit, whether the others absorb light, all alike.

        Returns:
            For each fit, the light, and the robust errors of red, green and blue, summed by view.
        """
        settings = self._settings
        size, is_dense = float((body.box[1] - body.box[0]).max()), (body.iors != 1)[:, None]
        path = self._path(body.with_absorption_coefficients(is_dense.expand(-1, 3) / size))
        lengths = -size * path.whole_transmittance().log()
        main = path.main_polyline(lengths)
        length = float(main[main > 0].mean())
        recorded, share = recorded_and_clipped(self._surroundings.background(path.exits()))

        def fit(absorbs: bool) -> tuple[ObservedLight, Float[np.ndarray, "3 V"]]:
            # Logarithms of the optical depth of the mean path, and of the excess of clipped radiance over 1.
            start = torch.tensor([[settings.initial_depth], [settings.initial_excess]])
            logarithms = start.log().repeat(1, 3).requires_grad_()
            optimizer = torch.optim.Adam([logarithms])
            with torch.enable_grad():
                for step in range(settings.light_steps + 1):
                    depth, excess = logarithms.exp()
                    depth = depth.clamp(max=settings.max_depth)
                    transmitted = torch.exp(-depth * lengths / length) if absorbs else 1.0
                    radiance = path.sum_polylines((recorded + share * excess) * transmitted).clamp(max=1)
                    residuals = radiance - self._pixels.radiance
                    optimizer.param_groups[0]["lr"] = settings.light_rate * (1 - step / settings.light_steps)
                    optimizer.zero_grad()
                    geman_mcclure(residuals[..., None], self._scale).mean().backward()
                    optimizer.step()  # the rate of the last step is 0
            errors = np.array([self._sums(residuals[:, channel : channel + 1].detach()) for channel in range(3)])
            absorption = is_dense * (absorbs * depth.detach() / length)
            return ObservedLight(absorption, length, 1 + share.any(0) * excess.detach()), errors

        return [fit(value) for value in absorbs]

    def _path(self, body: Medium) -> Path:
        """Trace the pixels."""
        return body.with_absorption(self._sampler(self._pixels.rays, body).in_room_of(self._pixels.rays))

    def _sums(self, residuals: Float[Tensor, "Q C"]) -> Float[np.ndarray, "V"]:
        """Sum the robust errors of residuals by view."""
        return np.bincount(self._pixels.view, geman_mcclure(residuals, self._scale).double(), len(self.counts))

    def mean(self, errors: Float[np.ndarray, "V"]) -> float:
        """Average the errors of all views: 0 for exact colours, 1 for outliers."""
        return float(mean_errors(errors[None], self.counts)[0, 0])

    def decreases(self, before: Float[np.ndarray, "V"], after: Float[np.ndarray, "V"], num_errors: float) -> bool:
        """Test whether the error decreases by a number of standard errors, by resampling of the views."""
        gains = mean_errors((before - after)[None], self.counts, self.samples)
        return bool(gains.mean() > num_errors * standard_error(gains, self.counts))


def unsupported_bodies(
    observations: Observations,
    solid: Bodies,
    index_is_doubtful: bool,
    vessel: Bodies | None,
    settings: ObjectErrorSettings = ObjectErrorSettings(),
) -> list[str]:
    """Print the errors of bodies, and return the names of those without support, the smallest error first.

    A body is supported if its error is significantly smaller than that of straight rays, and if it gains at least three
    quarters of the gain of the best body.

    Args:
        observations: observations of the object and its surroundings.
        solid: solid body with the index that was found.
        index_is_doubtful: whether to compare bodies of water and of glass instead.
        vessel: fitted vessel, if any.
        settings: limits of the support.
    """
    iors = {f"{SOLID}, {name}": ior for name, ior in COMMON_INDICES.items()} if index_is_doubtful else {}
    bodies = {name: _with_index(solid, ior) for name, ior in iors.items()} or {SOLID: solid}
    bodies |= {} if vessel is None else {VESSEL: vessel}
    measured = ObjectErrors(observations, settings=settings)
    errors = {name: measured.of(body) for name, body in {STRAIGHT: _with_index(solid, 1.0), **bodies}.items()}
    print("error of the object's pixels against the surroundings in the exit directions (0: exact, 1: unrelated):")
    for name, error in errors.items():
        print(f"  {name:<20}{measured.mean(error):>9.3f}")
    gains = {name: measured.mean(errors[STRAIGHT]) - measured.mean(errors[name]) for name in bodies}
    supported = [
        name
        for name in bodies
        if measured.decreases(errors[STRAIGHT], errors[name], settings.num_errors)
        and gains[name] > settings.min_gain * max(gains.values())
    ]
    print(f"bodies that these pixels support: {', '.join(supported) or 'none'}")
    return sorted((name for name in bodies if name not in supported), key=gains.__getitem__, reverse=True)


def observed_light(
    observations: Observations, body: Bodies, settings: ObjectErrorSettings = ObjectErrorSettings()
) -> ObservedLight:
    """Measure absorption and reflection of a body by the colours of its pixels against the surroundings.

    Absorption and reflection count if they decrease the error significantly.

    Args:
        observations: observations of the object and its surroundings.
        body: bodies with known indices.
        settings: number of pixels, steps and limits.
    """
    through, both = (ObjectErrors(observations, settings=settings, branches=branches) for branches in ("none", "all"))
    (light, errors), (clear, clear_errors) = both.fit_light(body, absorbs=(True, False))
    absorbs = torch.tensor(
        [
            share >= settings.min_share and both.decreases(before, after, settings.num_errors)
            for share, before, after in zip(light.absorbed, clear_errors, errors, strict=True)
        ]
    )
    best = errors.sum(0) if absorbs.any() else clear_errors.sum(0)
    [(_, without)] = through.fit_light(body, absorbs=(bool(absorbs.any()),))
    return replace(
        light,
        absorption=torch.where(absorbs, light.absorption, 0.0),
        clipped_radiance=torch.where(absorbs, light.clipped_radiance, clear.clipped_radiance),
        reflects=both.decreases(without.sum(0), best, settings.num_errors),
    )


def _with_index(solid: Bodies, ior: float) -> Bodies:
    return solid.with_indices(torch.full_like(solid.indices, ior))
