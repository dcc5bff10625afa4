"""Refinement of a surface by gradient descent on the error of photographs.

Pixels inside the silhouette of a transparent body show the surroundings in the exit directions of their rays. The
surface is displaced until the surroundings in the exit directions have the colours of the pixels, with derivatives of
the exact paths (`samplers.paths.replay`). Measured absorption and partial reflections are included if they explain the
photographs better. Three measures make the descent converge:

- The surroundings of inaccurate surfaces are blurred first, because the gradient of a photograph is informative only
  over the width of its details. Accurate surfaces need small steps and sharp surroundings; blur would make them worse.
- The error is robust, because pixels that show opaque objects inside the body have large errors for every surface.
- The contours of the surface stay in place, because the masks determine the contours. A surface that loses overlap
  with the masks is rejected.

The photographs of validation views select the surface, and how much the surface is smoothed before and after the
descent, because a visual hull is as rough as its voxels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.backgrounds.cube_map import texel_directions
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.capture.object_errors import ObservedLight, observed_light
from nerfro.capture.preprocess_options import FIGURES
from nerfro.capture.surroundings import (
    Observations,
    Pixels,
    Room,
    RoomPanorama,
    Surroundings,
    panorama_of,
    recorded_radiance,
)
from nerfro.core.errors import NerfroError, warn
from nerfro.core.progress import counting_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.rays import Rays
from nerfro.core.robust import geman_mcclure
from nerfro.core.types import Exits, Path
from nerfro.files.atomic import write_json
from nerfro.geometry.interpolation import bspline_basis, smooth
from nerfro.geometry.mesh import TriangleMesh, subdivided
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.polylines import SnellTrace
from nerfro.samplers.paths.snell import Snell
from nerfro.silhouettes.agreement import overlap
from nerfro.silhouettes.moving_mesh import MovingMesh
from nerfro.silhouettes.rims import find_rims, outlines_of
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.silhouettes.visual_hull import Silhouettes


@dataclass(frozen=True)
class DescentStage:
    """A number of steps with one learning rate schedule.

    Attributes:
        steps: number of steps.
        rate: initial learning rate of displacements (see `Displacement`) and indices; follows half a cosine to zero.
        blur: initial and final standard deviation of the blur of the surroundings, in degrees; 0 for no blur.
    """

    steps: int
    rate: float
    blur: tuple[float, float]

    @property
    def is_blurred(self) -> bool:
        """Whether the surroundings are blurred."""
        return self.blur[0] > 0


@dataclass(frozen=True)
class RefinementSettings(AlgorithmSettings):
    """Settings of the refinement. docs/lab/surface_refinement.md describes how the defaults were chosen.

    Attributes:
        stages: stages of the descent. Each stage starts with the best surface so far. A stage with blurred surroundings
            that gains less than `min_gain` is undone, and others are left out: the surface is too accurate for them.
        edge_voxels: longest edge of the mesh whose vertices move, in voxels of the medium; longer ones are bisected, or
            triangles would hide the displacement between their vertices.
        num_pixels: number of pixels in each step.
        levels: numbers of control points along each side of the splines that displace the surface.
        least_weight: smallest share of light that is followed separately at a surface that reflects partially.
        min_known: a pixel is used if at least this share of its light comes from known surroundings.
        min_light: a path has derivatives if it carries at least this share of the light of its pixel.
        smoothings: standard deviations of the tested smoothings, as fractions of the object's size.
        max_overlap_loss: largest decrease of the mean overlap with the silhouettes, because smoothing decreases the
            error a little even where it cuts edges. Infinite for silhouettes that are no masks.
        max_validation_pixels: largest number of validation pixels.
        validate_every: number of steps between validations.
        min_gain: smallest decrease of the validation error by a blurred stage that is kept, and by all stages together
            if the surface is accepted, as a fraction. A wrong surface also explains some of the interior: errors
            decreased by 0.012 to 0.11 for better surfaces, and by up to 0.009 for worse ones.
        min_absorption_gain: smallest decrease of the validation error by measured absorption that is used, as a
            fraction. Content has an effect on colours that resembles weak absorption.
        robust_scale: scale of the Geman-McClure loss relative to the mean transmittance of the object, linear radiance:
            residual at which the loss is 1/2 of its maximum and the weight 1/4.
        contour_deviation: standard deviation of contours, in pixels.
        contour_weight, roughness_weight: weights of contours and of roughness, relative to the photometric error.
        num_contour_points: number of contour points in each step.
        blur_samples: number of directions over which blurred surroundings are averaged.
        texels_per_deviation: resolution of blurred surroundings, in texels per standard deviation of the blur.
    """

    stages: tuple[DescentStage, ...] = (
        DescentStage(200, 2e-4, (3.0, 1.4)),
        DescentStage(300, 1.5e-4, (1.4, 0.5)),
        DescentStage(800, 3e-5, (0.0, 0.0)),
    )
    num_pixels: int = 8000
    levels: tuple[int, ...] = (12, 24)
    least_weight: float = 0.02
    min_known: float = 0.95
    min_light: float = 0.5
    smoothings: tuple[float, ...] = (0.005, 0.007, 0.01, 0.014)
    max_overlap_loss: float = 0.003
    max_validation_pixels: int = 20_000
    validate_every: int = 25
    min_gain: float = 0.01
    min_absorption_gain: float = 0.1
    robust_scale: float = 0.1
    contour_deviation: float = 0.25
    contour_weight: float = 0.1
    roughness_weight: float = 0.1
    num_contour_points: int = 4000
    edge_voxels: float = 4.0
    blur_samples: int = 32
    texels_per_deviation: float = 1.5


@dataclass(frozen=True)
class RefinementProblem:
    """A surface and the photographs that it must explain.

    Attributes:
        mesh: the surface.
        medium: the bodies with estimated indices, and absorption if it is given; dispersion is ignored. The mesh is the
            surface of the first one.
        silhouettes: silhouettes of the surface, whose outlines are kept.
        through: pixels inside the silhouette of the object.
        surroundings: known surroundings, near or distant.
        light: measured absorption and radiance of clipped surroundings, which are used if they decrease the error of
            the validation pixels.
    """

    mesh: TriangleMesh
    medium: Bodies
    silhouettes: Silhouettes
    through: Pixels
    surroundings: Surroundings
    light: ObservedLight | None = None


@dataclass(frozen=True)
class Refined:
    """Result of a refinement.

    Attributes:
        mesh: the refined surface; the given one without a significant improvement.
        medium: medium of the surface.
        steps: number of steps at each validation, which starts with 0, 0 for the given surface and for the smoothed
            one. The last number is repeated for the best surface of the stages that are kept, after its smoothing.
        errors: mean robust error of the validation pixels at each validation: 0 for exact colours, 1 for outliers.
    """

    mesh: TriangleMesh
    medium: Bodies
    steps: list[int]
    errors: list[float]


@torch.no_grad()
def refine_surface(
    problem: RefinementProblem, learn_index: bool = False, settings: RefinementSettings = RefinementSettings()
) -> Refined:
    """Refine the surface of the first body of a medium by the refractions in photographs.

    Args:
        problem: the surface and the photographs.
        learn_index: whether to refine the indices together with the surface.
        settings: settings of the descent.

    Raises:
        NerfroError: no pixel shows known surroundings through the object.
    """
    settings.use()
    descent = _Descent(problem, learn_index, settings)
    first, best = float(descent.initial_errors.mean()), _Candidate(descent.values(), descent.start_error)
    history, skips_blurred = [(0, first), (0, best.error)], False
    with counting_bar("surface", sum(stage.steps for stage in settings.stages)) as advance:
        for number, stage in enumerate(settings.stages):
            if skips_blurred and stage.is_blurred:
                advance(stage.steps)
                continue
            descent.begin(best.values, seed=number)
            candidate = _follow(descent, stage, best, history, advance)
            if stage.is_blurred and candidate.error > (1 - settings.min_gain) * best.error:
                skips_blurred = True
            else:
                best = candidate
        descent.begin(best.values)
        refined, error = descent.smoothed(descent.medium(), best.error)
    history.append((history[-1][0], error))
    steps, errors = map(list, zip(*history, strict=True))
    if error > (1 - settings.min_gain) * first or not descent.keeps_outlines(refined):
        return Refined(problem.mesh, problem.medium, steps, errors)
    return Refined(_project_onto(problem.mesh, refined), refined, steps, errors)


def _follow(
    descent: _Descent,
    stage: DescentStage,
    best: _Candidate,
    history: list[tuple[int, float]],
    advance: Callable[..., None],
) -> _Candidate:
    """Follow a stage, record its validation errors, and return the best surface of the stage and before it."""
    settings = descent.settings
    for step in range(stage.steps):
        descent.step(stage, step)
        advance()
        if (step + 1) % settings.validate_every == 0:
            error = descent.validation_error(descent.medium())
            history.append((history[-1][0] + settings.validate_every, error))
            if error < best.error:
                best = _Candidate(descent.values(), error)
    return best


def refine(
    observations: Observations,
    mesh: TriangleMesh,
    medium: Medium,
    silhouettes: Silhouettes | None,
    learn_index: bool,
    folder: FilePath,
) -> TriangleMesh:
    """Refine a surface with a progress bar, write refinement.json, and print the improvement.

    Args:
        observations: observations of the object and its surroundings.
        mesh: the surface, in the coordinates that `observations.shift` refers to.
        medium, learn_index: see `refine_surface`.
        silhouettes: silhouettes of the masks in the coordinates of the mesh; None uses projections of the mesh.
        folder: output folder.

    Returns:
        The refined surface; the given one without a significant improvement, or if the refinement is impossible.
    """
    through, cameras, bodies = observations.through, observations.views.cameras, medium.bodies
    assert bodies is not None  # see Request.check
    is_given = any(material.absorbs and "absorption" not in material.learned() for material in bodies.materials)
    light = None if is_given else observed_light(observations, bodies)
    settings = RefinementSettings()
    max_edge = settings.edge_voxels * float(bodies.grids[0].spacing.min())
    start = subdivided(mesh.relative_to(observations.shift), max_edge)
    if silhouettes is None:
        settings = replace(settings, max_overlap_loss=math.inf)
        silhouettes = Silhouettes.of(cameras, mesh_silhouettes(start, cameras, 1).float())
    else:
        silhouettes = replace(silhouettes, cameras=silhouettes.cameras.relative_to(observations.shift))
    problem = RefinementProblem(start, bodies, silhouettes, through, observations.surroundings, light)
    try:
        refined = refine_surface(problem, learn_index, settings)
    except NerfroError as reason:  # keep the results of the other steps
        warn(f"surface unchanged: {reason}")
        return mesh
    before, after = refined.errors[0], refined.errors[-1]
    change = f"the validation error changes from {before:.4f} to {after:.4f} (0: exact, 1: unrelated images)"
    if refined.mesh is start:
        print(f"surface unchanged: {change}, which is not significant")
    else:
        mesh = refined.mesh.relative_to(-observations.shift)
        moved = float(torch.from_numpy(refined.mesh.vertices - start.vertices).norm(dim=-1).median())
        print(f"surface refined and used: {change}; median displacement {moved:.2g} world units")
    figures = {"steps": refined.steps, "validation_error": [round(error, 5) for error in refined.errors]}
    write_json(folder / FIGURES, figures)
    return mesh


class Displacement(nn.Module):
    """Outward displacement of a surface in world units: a sum of cubic B-splines on grids over a box.

    The learned coefficients have no unit. A coefficient of 1 moves the surface by the object's size on the coarsest
    grid, and by less on finer ones in proportion to the distance of their control points. One learning rate therefore
    changes the slope of the surface alike on all levels.

    Args:
        shape: number of vertices of the grid at which the displacement is evaluated, along x, y and z.
        size: size of the object, world units.
        levels: control points along each side of the splines, the coarsest grid first.
    """

    def __init__(self, shape: tuple[int, ...], size: float, levels: tuple[int, ...]) -> None:
        super().__init__()
        self.levels = nn.ParameterList(nn.Parameter(torch.zeros(n, n, n)) for n in levels)
        self.scales = [size * levels[0] / n for n in levels]
        self._bases = [[bspline_basis(n, length) for length in shape] for n in levels]

    def forward(self) -> Float[Tensor, "X Y Z"]:
        """Evaluate the displacement at all vertices of the grid."""
        terms = zip(self.scales, self.levels, self._bases, strict=True)
        return sum(scale * torch.einsum("ijk,xi,yj,zk->xyz", values, *bases) for scale, values, bases in terms)  # type: ignore[return-value]

    def roughness(self) -> Float[Tensor, ""]:
        """Return the mean square of second differences between control points, as slopes of the surface."""
        coarsest = len(self.levels[0])
        return sum(  # type: ignore[return-value]
            (values.diff(n=2, dim=axis) * (coarsest * (len(values) - 3) / len(values))).square().mean()
            for values in self.levels
            for axis in range(3)
        )


class _Candidate(NamedTuple):
    """Learned values of a descent, and the validation error of their surface."""

    values: list[Tensor]
    error: float


class _Descent:
    """Displacements and indices with their optimizer, training pixels and validation pixels."""

    def __init__(self, problem: RefinementProblem, learn_index: bool, settings: RefinementSettings) -> None:
        self.problem, self.settings = problem, settings
        mesh, silhouettes = problem.mesh, problem.silhouettes
        self.training, validation = problem.through.split()
        self.validation = validation.some(settings.max_validation_pixels)
        self.robust_scale = settings.robust_scale
        medium, self.surroundings, self.sampler = self._best_model()
        self.robust_scale *= self._transmittance(medium)
        self.iors = nn.Parameter(medium.iors.clone(), requires_grad=learn_index)
        # Paths with more events have no derivatives here, because small errors of the surface turn them far.
        self.max_events = 2 * len(medium.iors) + 1
        self.size = float(np.ptp(mesh.bounds, axis=0).max())
        self.offsets = Displacement(tuple(medium.grids[0].distances.shape), self.size, settings.levels)
        self.learned = [*self.offsets.levels, self.iors]
        errors, is_valid = self._validation_errors(medium)
        if not is_valid.any():
            raise NerfroError("no pixel shows known surroundings through the object; remove refine=true")
        self.validation, self.initial_errors = self.validation[is_valid], errors[is_valid]
        self.overlap = overlap(mesh, silhouettes).mean()
        surface, cameras = MovingMesh(mesh.faces).geometry(mesh.vertices), silhouettes.cameras
        rims = find_rims(surface, silhouettes, outlines_of(silhouettes))
        self.rims = torch.from_numpy(rims.points).float()
        middle = torch.from_numpy(mesh.bounds.mean(0)).float()
        distance = (cameras.camera_to_world[:, :, 3] - middle).norm(dim=-1)
        self.contour_deviation = settings.contour_deviation * float((distance / cameras.fx).mean())
        background = self.surroundings.background
        self.panorama = panorama_of(background, medium, middle) if isinstance(background, Room) else background
        # The displacements count from the smoothed surface.
        self.start, self.start_error = self.smoothed(medium, float(self.initial_errors.mean()))

    def medium(self) -> Bodies:
        """Return the current medium."""
        return self.start.grown(self.offsets()).with_indices(self.iors)

    def values(self) -> list[Tensor]:
        """Return a copy of the learned values."""
        return [values.detach().clone() for values in self.learned]

    def begin(self, values: list[Tensor], seed: int = 0) -> None:
        """Set the learned values, and reset optimizer and random numbers."""
        for learned, value in zip(self.learned, values, strict=True):
            learned.copy_(value)
        self.optimizer = torch.optim.Adam(self.learned, betas=(0.9, 0.99), eps=1e-12)
        self.generator = torch.Generator().manual_seed(seed)

    def step(self, stage: DescentStage, step: int) -> None:
        """Make one step of a stage."""
        done = step / stage.steps
        if step % self.settings.validate_every == 0:
            degrees = stage.blur[0] + (stage.blur[1] - stage.blur[0]) * done
            surroundings = replace(self.surroundings, background=self.panorama)
            self.blurred = _blurred(surroundings, degrees, self.settings)
        self.optimizer.param_groups[0]["lr"] = stage.rate * 0.5 * (1 + math.cos(math.pi * done))
        self.optimizer.zero_grad()
        with torch.enable_grad():
            self._loss().backward()
        self.optimizer.step()

    def _loss(self) -> Tensor:
        medium, settings = self.medium(), self.settings
        pixels = self.training[torch.randint(len(self.training), (settings.num_pixels,), generator=self.generator)]
        path, known = self._traced(pixels.rays, medium)
        radiance = recorded_radiance(medium.with_absorption(path), self.blurred)
        errors = geman_mcclure((radiance - pixels.radiance)[known], self.robust_scale)
        photometric = errors.sum() / max(1, len(errors))
        rims = self.rims[torch.randint(len(self.rims), (settings.num_contour_points,), generator=self.generator)]
        current, initial = (solid.grids[0](rims)[0] for solid in (medium, self.problem.medium))
        square = ((current - initial) / self.contour_deviation).square()
        contours = (square / (1 + square)).mean()
        return photometric + settings.contour_weight * contours + settings.roughness_weight * self.offsets.roughness()

    def smoothed(self, medium: Bodies, error: float) -> tuple[Bodies, float]:
        """Smooth the first body as far as the validation error decreases and the outlines stay.

        Args:
            medium: the medium.
            error: validation error of the medium.

        Returns:
            The medium and its validation error.
        """
        grid, best = medium.grids[0], medium
        for fraction in self.settings.smoothings:
            sigma = fraction * self.size / float(grid.spacing.min())
            candidate = medium.grown(grid.distances - smooth(grid.distances, 2 * math.ceil(3 * sigma) + 1, sigma))
            if (new := self.validation_error(candidate)) < error and self.keeps_outlines(candidate):
                best, error = candidate, new
        return best, error

    def keeps_outlines(self, medium: Bodies) -> bool:
        """Test that the overlap with the masks falls by at most `max_overlap_loss`."""
        if self.settings.max_overlap_loss == math.inf:
            return True
        after = overlap(_project_onto(self.problem.mesh, medium), self.problem.silhouettes).mean()
        return bool(self.overlap - after <= self.settings.max_overlap_loss)

    def validation_error(self, medium: Bodies) -> float:
        """Compute the mean robust error of the validation pixels.

        Pixels with unknown surroundings for the new surface keep their initial error, so that a surface cannot
        lower its error by hiding pixels.
        """
        errors, is_valid = self._validation_errors(medium)
        return float(torch.where(is_valid, errors, self.initial_errors).mean())

    def _best_model(self) -> tuple[Bodies, Surroundings, Snell]:
        """Choose absorption and partial reflections by the validation pixels that all choices explain."""
        problem, medium = self.problem, self.problem.medium.achromatic()
        light = [(medium, problem.surroundings)]
        if problem.light is not None:
            absorbing = medium.with_absorption_coefficients(problem.light.absorption)
            brighter = replace(problem.surroundings, clipped_radiance=problem.light.clipped_radiance)
            light.append((absorbing, brighter))
        samplers = Snell(), Snell(branches="all", least_weight=self.settings.least_weight)
        models = [(*seen, sampler) for seen in light for sampler in samplers]
        errors, common = list[Tensor](), torch.tensor(True)
        for model in models:
            medium, self.surroundings, self.sampler = model
            error, is_valid = self._validation_errors(medium)
            errors.append(error)
            common = common & is_valid
        means = torch.stack(errors)[:, common].mean(1).nan_to_num(torch.inf)
        means[len(samplers) :] /= 1 - self.settings.min_absorption_gain
        return models[int(means.argmin())]

    def _validation_errors(self, medium: Bodies) -> tuple[Float[Tensor, "Q"], Bool[Tensor, "Q"]]:
        """Compute the robust errors of the validation pixels, and whether their surroundings are known."""
        trace = self.sampler.trace(self.validation.rays, medium)
        path = trace.path.in_room_of(self.validation.rays)
        radiance = recorded_radiance(medium.with_absorption(path), self.surroundings.radiance)
        errors = geman_mcclure(radiance - self.validation.radiance, self.robust_scale)
        return errors, self._shows_known(trace, path)

    def _transmittance(self, medium: Bodies) -> float:
        """Return the mean transmittance of all colours along the rays of the validation pixels, without reflections."""
        path = Snell()(self.validation.rays, medium)
        return float(medium.with_absorption(path).whole_transmittance().mean())

    def _shows_known(self, trace: SnellTrace, path: Path) -> Bool[Tensor, "R"]:
        """Test which rays meet the object and show known surroundings."""
        known = self.surroundings.known(path.exits()) & ~trace.exceeded
        return (path.sum_polylines(known.float()) >= self.settings.min_known) & path.main_polyline(path.refracted)

    def _traced(self, rays: Rays, medium: Bodies) -> tuple[Path, Bool[Tensor, "R"]]:
        """Trace rays, with derivatives of reliable paths, and test which rays show known surroundings."""
        with torch.no_grad():
            trace = self.sampler.trace(rays, medium)
            path = trace.path.in_room_of(rays)
            known = self._shows_known(trace, path)
            is_reliable = self.sampler.steady(path, medium) & (trace.num_events <= self.max_events)
            is_bright = path.throughput.mean(-1) >= self.settings.min_light
            rows = (is_reliable & is_bright & path.refracted & path.broadcast_to_polylines(known)).nonzero()[:, 0]
        return self.sampler.replay_rows(path, rays, medium, rows), known


def _blurred(surroundings: Surroundings, degrees: float, settings: RefinementSettings) -> Callable[[Exits], Tensor]:
    """Convolve the radiance of surroundings with a Gaussian of the given standard deviation."""
    if degrees == 0:
        return surroundings.radiance
    panorama = surroundings.background
    sky = replace(surroundings, background=panorama.colours) if isinstance(panorama, RoomPanorama) else surroundings
    generator = torch.Generator().manual_seed(0)
    side = round(settings.texels_per_deviation * 90 / degrees)  # a face of the cube spans 90 degrees
    directions = texel_directions(max(16, side))
    total = torch.zeros_like(directions)
    for _ in range(settings.blur_samples):
        turned = directions + math.radians(degrees) * torch.randn(3, generator=generator)
        total += sky.radiance(Exits(turned / turned.norm(dim=-1, keepdim=True)))
    blurred = EnvironmentMap.of_texels(total / settings.blur_samples)
    return RoomPanorama(panorama.middle, blurred, panorama.distances) if isinstance(panorama, RoomPanorama) else blurred


def _project_onto(mesh: TriangleMesh, medium: Bodies) -> TriangleMesh:
    """Move the vertices of a mesh onto the zero level of the first body, by Newton's method."""
    vertices = torch.from_numpy(mesh.vertices).float()
    grid = medium.grids[0]
    spacing = float(grid.spacing.min())
    for _ in range(5):
        phi, gradient = grid(vertices)
        # On ridges, where the gradient nearly vanishes, the steps would be too long.
        square = gradient.square().sum(-1, keepdim=True).clamp(min=0.5**2)
        vertices = vertices - (phi[:, None] * gradient / square).clamp(-spacing, spacing)
    return TriangleMesh(vertices.double().numpy(), mesh.faces)
