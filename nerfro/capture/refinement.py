"""A surface moved until what is seen through it is seen where it is: descent on the photographs' error.

Pixels that look through a clear body show its surroundings, in the direction in which their rays leave. The surface
moves so that these are the directions in which the surroundings have the pixels' colours, by the derivative of the
exact paths (`samplers.replay`). Three things keep it on the way:

- Blurred surroundings first. Their slope tells the way over as many degrees as they are blurred.
- A robust error. Pixels that show opaque things inside have large ones, wherever the surface is, and hardly pull.
- Outlines. Where a surface is seen from its side, the masks have told where it is, and it stays there.

Photographs of some views are held back and judge: the surface is the one that explains them best. They also say how
much it is smoothed, before the descent and after it, for a hull is as rough as its voxels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nerfro.boundaries.base import Boundary
from nerfro.boundaries.cube_map import texel_directions
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.capture.displacement import Displacement
from nerfro.capture.record import Record
from nerfro.capture.rims import RimFinder
from nerfro.capture.room_picture import RoomPicture, picture_of
from nerfro.capture.surroundings import Pixels, Room, Surroundings, robust
from nerfro.capture.visual_hull import Silhouettes
from nerfro.errors import NerfroError
from nerfro.files.cache import content_hash
from nerfro.geometry.interpolation import quadratic_spline, smooth
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.sdf_grid import SdfGrid
from nerfro.samplers.snell import Snell
from nerfro.types import Exits, Path
from nerfro.variants import variant

_JUDGED = 20_000  # held-back pixels, at most
# Residuals of linear radiance count half at this.
_HALF = 0.1
# Part of the key of a record: raise it when the same inputs lead elsewhere than before.
_VERSION = 2
# An outline is known to about this, pixels; weights of outlines and of smoothness.
_OUTLINE, _OUTLINES, _SMOOTH = 0.25, 0.1, 0.1
_RIMS = 4000  # points of outlines of a step


@dataclass(frozen=True)
class Stage:
    """Steps at one pace.

    Attributes:
        steps: their number.
        rate: how far the first step moves the surface, see `Displacement`, and an index; it falls along half a cosine.
        blur: standard deviation of the surroundings' blur at the beginning and at the end, degrees; 0 for none.
    """

    steps: int
    rate: float
    blur: tuple[float, float]


@dataclass(frozen=True)
class RefinementSettings:
    """How a surface is refined. The defaults were chosen on the wavy body and on `starlamp`, see docs/capture.md.

    Attributes:
        stages: of the descent. The first ones are too bold for a surface that is nearly right. They are left when it
            is worse by a share, and so is whatever is not the best when a stage ends.
        num_pixels: pixels of a step.
        levels: control points along each side of the splines that displace the surface.
        smoothings: standard deviations of the smoothing that is tried, in shares of the object's size.
    """

    stages: tuple[Stage, ...] = (
        Stage(200, 2e-4, (3.0, 1.4)),
        Stage(300, 1.5e-4, (1.4, 0.5)),
        Stage(150, 4e-5, (0.7, 0.35)),
        Stage(100, 1e-5, (0.0, 0.0)),
    )
    num_pixels: int = 6000
    levels: tuple[int, ...] = (12, 24, 48)
    smoothings: tuple[float, ...] = (0.005, 0.007, 0.01, 0.014)


_WORSE = 0.03
_JUDGE_EVERY = 25  # steps
# A surface that makes held-back photographs better by a smaller share is not taken: reflections, tint and what is
# inside can be explained a little by a wrong surface too. It was 0.012 to 0.11 where the surface became better, and up
# to 0.009 where it did not.
_LEAST_GAIN = 0.01


@dataclass(frozen=True)
class Refined:
    """A surface that was moved.

    Attributes:
        mesh: the surface; the given one itself where none is clearly better.
        medium: made of it.
        steps, errors: after which steps it was judged, and the robust error of held-back pixels then: 0 where
            all is explained, 1 where nothing is. The first is that of the surface as it was.
    """

    mesh: TriangleMesh
    medium: SdfGrid
    steps: list[int]
    errors: list[float]


def refine_surface(
    mesh: TriangleMesh,
    medium: SdfGrid,
    silhouettes: Silhouettes,
    through: Pixels,
    surroundings: Surroundings,
    learn_index: bool = False,
    progress: Callable[[float], None] = lambda done: None,
    record: FilePath | None = None,
    settings: RefinementSettings = RefinementSettings(),
) -> Refined:
    """Move the outer surface of a medium by what photographs show through it.

    Args:
        mesh: the surface.
        medium: the bodies, with the indices that they have; white light alone is followed.
        silhouettes: of the surface; its outlines stay where they are.
        through: pixels that the object fills.
        surroundings: what is seen around it, near or far.
        learn_index: whether the indices are not known for sure, and learned along with the surface.
        progress: is told the share done.
        record: file in which the state is kept now and then, and from which a descent on the same pixels that was
            interrupted goes on; it is removed at the end.
        settings: of the descent.

    Raises:
        NerfroError: no pixel shows the surroundings through the object.
    """
    descent = _Descent(mesh, medium, silhouettes, through, surroundings, learn_index, settings)
    error = descent.judged(medium)
    picture = _picture(surroundings, mesh, medium)
    descent.start, smoothed = descent.smoothed(medium, error)
    at = _Position(descent.state(), [error, smoothed], [0, 0])
    kept = Record(record, _key(mesh, medium, through, learn_index, settings))
    if (found := kept.read()) is not None:
        at = _Position(**found["at"])
        descent.go_on(found["descent"])
    stages = settings.stages
    total = sum(stage.steps for stage in stages)
    while at.stage < len(stages):
        stage = stages[at.stage]
        done = sum(before.steps for before in stages[: at.stage])
        while at.step < stage.steps:
            if at.step % _JUDGE_EVERY == 0:
                share = at.step / stage.steps
                sky = _blurred(picture, stage.blur[0] + (stage.blur[1] - stage.blur[0]) * share)
            descent.step(sky, stage.rate * 0.5 * (1 + math.cos(math.pi * at.step / stage.steps)))
            at.step += 1
            progress((done + at.step) / total)
            if at.step % _JUDGE_EVERY == 0:
                at.steps.append(at.steps[-1] + _JUDGE_EVERY)
                at.errors.append(descent.judged(descent.moved()))
                if at.errors[-1] == min(at.errors):
                    at.best = descent.state()
                elif at.errors[-1] > (1 + _WORSE) * min(at.errors):
                    break
                kept.write({"at": asdict(at), "descent": descent.record()})
        descent.set(at.best)
        at.stage, at.step = at.stage + 1, 0
    moved, smoothed = descent.smoothed(descent.moved(), min(at.errors))
    progress(1.0)
    kept.remove()
    steps, errors = [*at.steps, at.steps[-1]], [*at.errors, smoothed]
    if smoothed > (1 - _LEAST_GAIN) * error:
        return Refined(mesh, medium, steps, errors)
    return Refined(_onto(mesh, moved), moved, steps, errors)


@dataclass
class _Position:
    """How far a descent is, and the best of its states; see `Refined` for the others."""

    best: list[Tensor]
    errors: list[float]
    steps: list[int]
    stage: int = 0
    step: int = 0  # of the stage


def _key(mesh: TriangleMesh, medium: SdfGrid, through: Pixels, learn_index: bool, settings: RefinementSettings) -> str:
    """Hash of what a descent depends on; surroundings are learned from the same photographs."""
    tensors = medium.box, medium.distances, medium.iors.float(), through.index, through.radiance
    arrays = (tensor.detach().numpy() for tensor in tensors)
    return content_hash(_VERSION, repr(settings), learn_index, mesh.vertices, mesh.faces, *arrays)


class _Descent:
    """The surface on its way from a start, and the pixels that teach and judge it."""

    def __init__(
        self,
        mesh: TriangleMesh,
        medium: SdfGrid,
        silhouettes: Silhouettes,
        through: Pixels,
        surroundings: Surroundings,
        learn_index: bool,
        settings: RefinementSettings,
    ) -> None:
        self.settings = settings
        self.given, self.start, self.surroundings = medium, medium, surroundings
        self.iors = nn.Parameter(medium.iors.clone(), requires_grad=learn_index)
        # Rays that are reflected inside are no help: tiny errors of the surface turn them anywhere.
        self.sampler = Snell(max_events=2 * len(medium.iors))
        self.size = float(np.ptp(mesh.bounds, axis=0).max())
        self.offsets = Displacement(tuple(medium.distances.shape[1:]), self.size, settings.levels)
        self.teachers, validation = through.split()
        self.judges = validation.some(_JUDGED)
        self.first_errors: Tensor | None = None
        self.rims = RimFinder(mesh, silhouettes).points().points
        cameras = silhouettes.cameras
        middle = torch.from_numpy(mesh.bounds.mean(0)).float()
        distance = (cameras.camera_to_world[:, :, 3] - middle).norm(dim=-1)
        self.outline = _OUTLINE * float((distance / cameras.fx).mean())
        self.generator = torch.Generator().manual_seed(0)
        self.set(self.state())

    def moved(self) -> SdfGrid:
        """The medium as it is now, without gradients."""
        with torch.no_grad():
            return self._moved()

    def state(self) -> list[Tensor]:
        return [values.detach().clone() for values in self._learned()]

    @torch.no_grad()
    def set(self, state: list[Tensor]) -> None:
        """Go on from a state, at rest."""
        for learned, values in zip(self._learned(), state, strict=True):
            learned.copy_(values)
        self.optimizer = torch.optim.Adam(self._learned(), betas=(0.9, 0.99), eps=1e-12)

    def record(self) -> dict[str, Any]:
        """All that changes on the way, in plain values and tensors."""
        return {
            "state": self.state(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
        }

    def go_on(self, record: dict[str, Any]) -> None:
        """Go on from where `record` was asked."""
        self.set(record["state"])
        self.optimizer.load_state_dict(record["optimizer"])
        self.generator.set_state(record["generator"])

    def _learned(self) -> list[nn.Parameter]:
        return [*self.offsets.levels, self.iors]

    def _moved(self) -> SdfGrid:
        return variant(self.start.grown(self.offsets()), iors=1.0 * self.iors)

    def step(self, sky: Boundary, rate: float) -> None:
        """Follow the slope of the error, with surroundings that are blurred."""
        self.optimizer.param_groups[0]["lr"] = rate
        self.optimizer.zero_grad()
        with torch.enable_grad():
            self._loss(sky).backward()
        self.optimizer.step()

    def _loss(self, sky: Boundary) -> Tensor:
        medium = self._moved()
        pixels = self.teachers[torch.randint(len(self.teachers), (self.settings.num_pixels,), generator=self.generator)]
        path, usable = self._traced(pixels, medium)
        rays = pixels.rays[usable]
        path = self.sampler.refine(path[usable], rays, medium)
        residual = sky(path.exits()).clamp(max=1) - pixels.radiance[usable]
        photometric = robust(residual, _HALF).sum() / max(1, len(rays))
        rims = self.rims[torch.randint(len(self.rims), (_RIMS,), generator=self.generator)]
        now, before = (quadratic_spline(each.coefficients[0], each.box, rims)[0] for each in (medium, self.given))
        left = ((now - before) / self.outline).square()
        outlines = (left / (1 + left)).mean()
        return photometric + _OUTLINES * outlines + _SMOOTH * self.offsets.roughness()

    @torch.no_grad()
    def smoothed(self, medium: SdfGrid, error: float) -> tuple[SdfGrid, float]:
        """The medium with its outer surface as smooth as the judges like it best, and their error; it has `error`."""
        distances = medium.distances[0]
        best = medium
        for share in self.settings.smoothings:
            sigma = share * self.size / float(medium.spacing.min())
            tried = medium.grown(distances - smooth(distances, 2 * math.ceil(3 * sigma) + 1, sigma))
            if (judged := self.judged(tried)) < error:
                best, error = tried, judged
        return best, error

    @torch.no_grad()
    def judged(self, medium: SdfGrid) -> float:
        """The robust error of held-back pixels whose light came from known surroundings at first.

        Where it does no more, the first error counts: a surface is neither better nor worse for that.
        """
        trace = self.sampler.trace(self.judges.rays, medium)
        radiance, known = self.surroundings.radiance(trace.path.exits())
        known &= ~trace.exceeded & trace.path.refracted
        errors = robust(radiance - self.judges.radiance, _HALF)
        if self.first_errors is None:
            if not known.any():
                raise NerfroError("no pixel shows known surroundings through the object; refine=true cannot help here")
            self.judges, errors = self.judges[known], errors[known]
            self.first_errors, known = errors, known[known]
        return float(torch.where(known, errors, self.first_errors).mean())

    def _traced(self, pixels: Pixels, medium: SdfGrid) -> tuple[Path, Tensor]:
        """Paths of pixels, and which are bent, end in known surroundings and have sound derivatives."""
        with torch.no_grad():
            trace = self.sampler.trace(pixels.rays, medium)
            known = self.surroundings.known(trace.path.exits())
            usable = known & ~trace.exceeded & trace.path.refracted & self.sampler.steady(trace.path, medium)
        return trace.path, usable


def _picture(surroundings: Surroundings, mesh: TriangleMesh, medium: SdfGrid) -> EnvironmentMap | RoomPicture:
    """Surroundings that have a slope, and can be blurred."""
    boundary = surroundings.boundary
    if isinstance(boundary, Room):
        return picture_of(boundary, medium, torch.from_numpy(mesh.bounds.mean(0)).float())
    return boundary


@torch.no_grad()
def _blurred(picture: EnvironmentMap | RoomPicture, degrees: float) -> Boundary:
    """A picture of surroundings, convolved with a Gaussian of that standard deviation; itself for none."""
    if degrees == 0:
        return picture
    sky = picture.colours if isinstance(picture, RoomPicture) else picture
    count, generator = 32, torch.Generator().manual_seed(0)
    directions = texel_directions(max(16, round(135 / degrees)))
    total = torch.zeros_like(directions)
    for _ in range(count):
        turned = directions + math.radians(degrees) * torch.randn(3, generator=generator)
        total += sky(Exits(turned / turned.norm(dim=-1, keepdim=True))).clamp(max=1)
    blurred = EnvironmentMap.of_texels(total / count)
    return RoomPicture(picture.middle, blurred, picture.distances) if isinstance(picture, RoomPicture) else blurred


def _onto(mesh: TriangleMesh, medium: SdfGrid) -> TriangleMesh:
    """The mesh with its vertices moved onto the zero level of a medium's first body, by Newton's steps."""
    vertices = torch.from_numpy(mesh.vertices).float()
    spacing = float(medium.spacing.min())
    for _ in range(5):
        phi, gradient = quadratic_spline(medium.coefficients[0], medium.box, vertices)
        square = gradient.square().sum(-1, keepdim=True).clamp(min=0.25)
        vertices = vertices - (phi[:, None] * gradient / square).clamp(-spacing, spacing)
    return TriangleMesh(vertices.double().numpy(), mesh.faces)
