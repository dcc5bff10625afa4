"""The refractive indices of a medium's bodies, found by where its rays end up in known surroundings.

For each candidate, pixels of the object are traced, and what they show is compared with the surroundings in the
direction in which their rays leave. The error has one wide valley around the true index: an error of 0.1 turns the
light that leaves a ball by some degrees, the more the farther from its middle.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerfro.capture.surroundings import Pixels, Room, Surroundings, robust
from nerfro.errors import NerfroError
from nerfro.media.solid import Solid
from nerfro.samplers.snell import Snell
from nerfro.variants import variant

LOWEST, HIGHEST = 1.0, 2.5  # indices that are searched
_RANGE = HIGHEST - LOWEST
# Candidates along each axis and pixels of the first look, by how many numbers are looked for.
_COARSE = {1: (31, 12_000), 2: (13, 4_000)}
# Candidates along each axis of closer looks, and how far they reach from its middle, as shares of what is searched.
_AROUND = {1: 9, 2: 5}
_REACHES = {1: (1 / 30, 1 / 75), 2: (1 / 75, 1 / 75)}
# Two numbers that trade lie in a narrow valley. Candidates reach farther along it than across, so many times at most;
# where it leads is told by derivatives at so many pixels: differences over this share of what is searched.
_ELONGATED, _SLOPE_PIXELS, _DIFFERENCE = 6.0, 6_000, 1 / 300
# Of a closer look, by how many numbers are looked for, and of one at surroundings that are rendered for each ray.
_FINE_PIXELS, _NEAR_PIXELS = {1: 60_000, 2: 20_000}, 12_000
_MOST_LOOKS = 10  # of each reach, until the middle stays where it is
# Rays with more events, or more than two for each surface, are no help: tiny errors of the surface turn them anywhere.
_MAX_EVENTS = 4
# Residuals count half at this share of the surroundings' standard deviation: what is inside spoils many pixels.
_HALF = 0.5
_RESAMPLES = 200
# Without a valley so deep (share of the error of unrelated colours), or with a larger standard error (share of what is
# searched), the pictures do not tell.
_SHALLOW, _LOOSE = 0.03, 0.02
_END = 1 / 150  # so near to an end of what is searched (share of it), the lowest error may lie beyond
# Nor if for less than this share of the pixels it is known where their light comes from.
_UNKNOWN = 0.1


@dataclass(frozen=True)
class Estimate:
    """Refractive indices of bodies, the outer one first, and how they were found.

    Attributes:
        names: of the bodies' indices, for people.
        values: the indices.
        standard_errors: by resampling views. What is wrong with the surface is not in them.
        curvature: second derivative of the error along each number.
        wide, close: candidates of the first look and of the last, with their robust errors in the last column: 0 where
            all is explained, 1 where nothing is. They are of other pixels and not to be compared.
        unrelated: the error of colours that have nothing to do with each other.
        doubts: why the pictures do not tell the numbers; empty where they do.
    """

    names: list[str]
    values: Float[np.ndarray, "K"]
    standard_errors: Float[np.ndarray, "K"]
    curvature: Float[np.ndarray, "K"]
    wide: Float[np.ndarray, "C N"]
    close: Float[np.ndarray, "c N"]
    unrelated: float
    doubts: list[str]


def find_indices(
    medium: Solid, through: Pixels, surroundings: Surroundings, progress: Callable[[float], None] = lambda done: None
) -> Estimate:
    """Search the indices of a medium's bodies, one or two, over all that they may be: coarse, then fine.

    Args:
        medium: the bodies; each is given one index for all colours.
        through: pixels that the object fills.
        surroundings: what is seen around it.
        progress: is told the share done.

    Raises:
        NerfroError: there are more than two bodies, or no ray of the pixels meets the medium.
    """
    count = len(medium.iors)
    if count not in _COARSE:
        raise NerfroError(f"the indices of {count} bodies are not searched for, but of two at most; give medium.ior=")
    names = ["index"] if count == 1 else [f"index of body {body + 1}" for body in range(count)]
    num_fine = _NEAR_PIXELS if isinstance(surroundings.boundary, Room) else _FINE_PIXELS[count]
    search = _Search(medium, through.some(num_fine), surroundings)
    per_axis, num_pixels = _COARSE[count]
    num_pixels = min(num_pixels, num_fine // 4)
    coarse = np.array(list(itertools.product(np.linspace(LOWEST, HIGHEST, per_axis), repeat=count)))
    share = len(coarse) * num_pixels / (len(coarse) * num_pixels + 4 * _AROUND[count] ** count * num_fine)
    costs = search.costs(coarse, num_pixels, False, lambda done: progress(share * done)).mean_error()
    middle = coarse[costs.argmin()]
    looks = len(_REACHES[count]) * _MOST_LOOKS
    look = 0
    for part in _REACHES[count]:
        steps = np.linspace(-1, 1, _AROUND[count])
        for _ in range(_MOST_LOOKS):
            reach = part * _RANGE * search.valley(middle)
            aside = np.abs(reach).sum(1)
            middle = middle.clip(LOWEST + aside, HIGHEST - aside)
            stencil = middle + np.array(list(itertools.product(steps, repeat=count))) @ reach.T
            begun, look = share + (1 - share) * look / looks, look + 1
            closest = part == _REACHES[count][-1]
            fine = search.costs(
                stencil,
                num_fine if closest else num_fine // 3,
                True,
                lambda done, b=begun: progress(b + (1 - share) * done / looks),  # type: ignore[misc]
            )
            errors = fine.mean_error()
            found, curvature = _lowest(stencil, errors[None], reach)
            settled = (np.abs(np.linalg.solve(reach, found[0] - middle)) < 0.5).all()
            middle = found[0].clip(LOWEST, HIGHEST)
            if settled:
                break
    progress(1.0)
    num_views = len(fine.counts)
    weights = np.random.default_rng(0).multinomial(num_views, np.full(num_views, 1 / num_views), _RESAMPLES)
    spread = _lowest(stencil, fine.mean_error(weights), reach)[0].std(0)
    known = fine.counts.sum() / max(1, search.num_pixels)
    doubts = _doubts(names, middle, spread, curvature[0], 1 - errors.min() / search.unrelated, known)
    wide, close = np.column_stack([coarse, costs]), np.column_stack([stencil, errors])
    return Estimate(names, middle, spread, curvature[0], wide, close, search.unrelated, doubts)


def _lowest(
    stencil: Float[np.ndarray, "C K"], errors: Float[np.ndarray, "B C"], reach: Float[np.ndarray, "K K"]
) -> tuple[Float[np.ndarray, "B K"], Float[np.ndarray, "B K"]]:
    """Where the parabolas through errors around a middle are lowest, and their second derivatives by each number.

    `reach` has in its columns how far the stencil reaches, in directions of its own. A parabola that has no lowest
    place near the stencil has it at the stencil's best candidate.
    """
    count, middle = stencil.shape[1], stencil.mean(0)
    back = np.linalg.inv(reach)
    x = (stencil - middle) @ back.T
    pairs = list(itertools.combinations_with_replacement(range(count), 2))
    terms = np.stack([np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)], 1)
    fitted = errors @ np.linalg.pinv(terms).T
    hessian = np.zeros((len(errors), count, count))
    for (i, j), factor in zip(pairs, fitted[:, 1 + count :].T, strict=True):
        hessian[:, i, j] += factor
        hessian[:, j, i] += factor
    regular = np.linalg.eigvalsh(hessian)[:, 0] > 1e-9
    hessian_or_one = np.where(regular[:, None, None], hessian, np.eye(count))
    place = -np.linalg.solve(hessian_or_one, fitted[:, 1 : 1 + count, None])[..., 0]
    near = regular & (np.abs(place).max(1) < 1.5)
    place = np.where(near[:, None], place, x[errors.argmin(1)])
    return middle + place @ reach.T, np.diagonal(back.T @ hessian @ back, axis1=1, axis2=2)


def _doubts(
    names: list[str], values: np.ndarray, standard_errors: np.ndarray, curvature: np.ndarray, depth: float, known: float
) -> list[str]:
    doubts = []
    if known < _UNKNOWN:
        doubts.append(f"of {1 - known:.0%} of the object's light no photograph shows where it comes from")
    if depth < _SHALLOW:
        doubts.append(
            f"the best {' and '.join(names)} explains only {max(0.0, depth):.1%} of what unrelated colours "
            "leave unexplained: the object may be opaque, or its surroundings not known where its light comes from"
        )
    end = _END * _RANGE
    for name, value, error, bend in zip(names, values, standard_errors, curvature, strict=True):
        if not LOWEST + end < value < HIGHEST - end:
            doubts.append(f"the {name} is at the end of what is searched, {LOWEST:.4g} to {HIGHEST:.4g}")
        elif bend <= 0 or error > _LOOSE * _RANGE:
            doubts.append(f"the {name} has a standard error of {error:.2g}: views do not agree on it")
    return doubts


@dataclass(frozen=True)
class _Costs:
    """Robust errors of candidates: sums over the pixels of each view, and how many pixels there are."""

    sums: Float[np.ndarray, "C V"]
    counts: Float[np.ndarray, "V"]

    def mean_error(self, weights: Float[np.ndarray, "B V"] | None = None) -> np.ndarray:
        """Mean over pixels of each candidate [C], or of each weighting of views [B, C]."""
        if weights is None:
            return self.sums.sum(1) / self.counts.sum().clip(1)
        return (weights @ self.sums.T) / (weights @ self.counts)[:, None].clip(1)


class _Search:
    def __init__(self, medium: Solid, through: Pixels, surroundings: Surroundings) -> None:
        self._white, self._surroundings = variant(medium, abbe=[]), surroundings
        medium = self._white.with_indices(torch.full_like(medium.iors, 0.5 * (LOWEST + HIGHEST)))
        self._sampler = Snell(max_events=max(_MAX_EVENTS, 2 * len(medium.iors)))
        self._pixels = through[self._sampler(through.rays, medium).refracted]
        self.num_pixels = len(self._pixels)
        if not self.num_pixels:
            raise NerfroError("no ray of the object's pixels meets its surface; mesh and poses do not belong together")
        colours = surroundings.colours
        self._half = max(_HALF * float(colours.std(0).mean()), 1e-3)
        other = colours[torch.randint(len(colours), (len(self._pixels),), generator=torch.Generator().manual_seed(1))]
        self.unrelated = float(robust(other - self._pixels.radiance, self._half).mean())

    def valley(self, place: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K K"]:
        """In columns, in shares of what is searched: directions across a valley and along it, where it is long.

        Of a single number it is 1. By products of the derivatives of robust residuals with each other.
        """
        count = len(place)
        if count == 1:
            return np.eye(count)
        pixels = self._pixels.some(_SLOPE_PIXELS)
        residuals, known = self._residuals(pixels, place)
        derivatives = []
        for away in _DIFFERENCE * _RANGE * np.eye(count):
            (ahead, known_ahead), (behind, known_behind) = (self._residuals(pixels, place + d) for d in (away, -away))
            derivatives.append(ahead - behind)
            known &= known_ahead & known_behind
        weights = (self._half**2 / (residuals.square().mean(-1) + self._half**2)).square()
        slopes = torch.stack(derivatives, -1)[known].double()
        products = torch.einsum("p,pci,pcj->ij", weights[known].double(), slopes, slopes).numpy()
        values, directions = np.linalg.eigh(products)
        if not values.max() > 0:  # nothing is known of any pixel
            return np.eye(count)
        return directions * np.sqrt(values.max() / values.clip(1e-9 * values.max())).clip(max=_ELONGATED)

    def _residuals(
        self, pixels: Pixels, values: Float[np.ndarray, "K"]
    ) -> tuple[Float[torch.Tensor, "P 3"], Bool[torch.Tensor, "P"]]:
        """How far off pixels are with a candidate, and for which it is known."""
        medium = self._white.with_indices(torch.from_numpy(values.clip(LOWEST, HIGHEST)))
        trace = self._sampler.trace(pixels.rays, medium)
        radiance, known = self._surroundings.radiance(trace.path.exits())
        return radiance - pixels.radiance, known & ~trace.exceeded

    def costs(
        self, candidates: Float[np.ndarray, "C K"], num_pixels: int, alike: bool, progress: Callable[[float], None]
    ) -> _Costs:
        """Errors of candidates. Where a ray's light comes from is not always known, and that differs among candidates.

        Far apart, they are compared by all pixels, with an error that favours none where nothing is known; `alike`
        ones by those pixels for which all know it, or they would be preferred for knowing more.
        """
        pixels = self._pixels.some(num_pixels)
        errors, everywhere = [], torch.ones(len(pixels), dtype=torch.bool)
        for number, values in enumerate(candidates):
            residuals, known = self._residuals(pixels, values)
            everywhere &= known
            errors.append(torch.where(known, robust(residuals, self._half), self.unrelated))
            progress((number + 1) / len(candidates))
        used = everywhere if alike else torch.ones_like(everywhere)
        view, num_views = pixels.view[used], len(pixels.cameras)
        sums = [torch.bincount(view, error[used].double(), num_views).numpy() for error in errors]
        return _Costs(np.stack(sums), torch.bincount(view, minlength=num_views).double().numpy())
