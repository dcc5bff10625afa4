"""Comparison of path samplers with closed forms of optics: a ball, a slab, a prism and a Luneburg lens."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.errors import NerfroError
from nerfro.core.types import Rays
from nerfro.geometry.mesh import make_mesh
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.material import Material
from nerfro.media.surfaces import BallSurface, MeshSurface, Surface
from nerfro.samplers.base import PathSampler
from nerfro.testing.contracts import ContractError
from nerfro.testing.examples import LuneburgLens

# Number of rays of each case.
_NUM_RAYS = 64
_RADIUS, _IOR = 0.8, 1.5


@dataclass(frozen=True)
class OpticalError:
    """Difference between a path sampler and a closed form, for rays of one kind.

    Attributes:
        body: traced body, such as `ball`.
        rays: description of the rays, such as `impact 0.5`.
        deviation: exact angle between the rays before and after the body, degrees.
        median, largest: angle between the traced and the exact exit directions, degrees.
        offset: median distance between the traced and the exact exit rays at the body, as a fraction of the body's
            half size. It shows errors that keep the direction, as behind a slab.
        refusal: message of a sampler that refuses the medium; the numbers are then nan.
    """

    body: str
    rays: str
    deviation: float
    median: float
    largest: float
    offset: float
    refusal: str = ""

    def __str__(self) -> str:
        label = f"{self.body:9}{self.rays:14}{self.deviation:10.3f}"
        errors = f"{self.median:10.3f}{self.largest:10.3f}{self.offset:10.4f}"
        return label + (f"  {self.refusal}" if self.refusal else errors)


def check_optics(sampler: PathSampler, tolerance: float = 0.1) -> list[OpticalError]:
    """Compare a path sampler with closed forms, and print the angles of deviation and their errors.

    A ball, a slab and a prism of index 1.5 are `Bodies` with the default shells; the Luneburg lens has a continuous
    index. Rows of media that the sampler refuses are printed and do not count.

    Args:
        sampler: path sampler, built as for a training.
        tolerance: largest accepted median error of the exit directions, degrees, and of the exit positions, as an
            angle seen from the distance of the half size of the body.

    Returns:
        One row for each body and kind of rays.

    Raises:
        ContractError: an error exceeds the tolerance, or the sampler refuses all media.
    """
    print("exit rays against closed forms: angles in degrees, offset in half sizes of the body")
    print("body     rays           deviation    median   largest    offset")
    errors = []
    for case in _cases(sampler.traces_triangles):
        errors.append(case.compare(sampler))
        print(errors[-1])
    if all(error.refusal for error in errors):
        raise ContractError(f"contract broken: the sampler traces none of these media: {errors[0].refusal}")
    wrong = [e for e in errors if not e.refusal and not max(e.median, math.degrees(e.offset)) <= tolerance]
    if wrong:
        worst = max(wrong, key=lambda error: max(error.median, math.degrees(error.offset)))
        raise ContractError(
            f"contract broken: the exit rays of {worst.body}, {worst.rays}, are wrong by {worst.median:.2f} degrees "
            f"and {worst.offset:.3f} half sizes, more than {tolerance:g} degrees; the index of bodies rises within "
            "2 medium.shell, so take steps of medium.step_length there and jump by medium.clearance elsewhere"
        )
    return errors


@dataclass(frozen=True)
class _Case:
    """Rays of one kind through a body, and the exact exit rays; positions are those of any point of the exit ray."""

    body: str
    rays: str
    medium: Medium
    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    exit_positions: Float[Tensor, "R 3"]
    exit_directions: Float[Tensor, "R 3"]

    def compare(self, sampler: PathSampler) -> OpticalError:
        like = torch.ones(_NUM_RAYS)
        rays = Rays(self.origins.float(), self.directions.float(), 0 * like, 0.5 * like, 6 * like)
        deviation = float(angle(self.directions, self.exit_directions).median())
        row = OpticalError(self.body, self.rays, deviation, math.nan, math.nan, math.nan)
        try:
            path = sampler.trace_main(rays, self.medium)
        except NerfroError as error:
            return replace(row, refusal=f"refused: {error}")
        path = path.select_rays(torch.arange(_NUM_RAYS))
        ends, directions = (path.main_polyline(v).double() for v in (path.end_positions, path.exit_directions))
        errors = angle(directions, self.exit_directions)
        # Two parallel lines with directions d are |p x d - q x d| apart.
        moments = torch.linalg.cross(ends, directions) - torch.linalg.cross(self.exit_positions, self.exit_directions)
        offset = float(moments.norm(dim=-1).median()) / (0.5 * float(np.ptp(self.medium.content_box, axis=0).max()))
        return replace(row, median=float(errors.median()), largest=float(errors.max()), offset=offset)


def _cases(with_triangles: bool) -> Iterable[_Case]:
    generator = torch.Generator().manual_seed(0)
    mesh = trimesh.creation.icosphere(5, _RADIUS)
    medium: Medium = _body("ball", _polyhedron(mesh, "smooth") if with_triangles else BallSurface(_RADIUS))
    for impact in (0.2, 0.5, 0.8):
        origins, directions = _towards_ball(impact * _RADIUS, generator)
        yield _Case("ball", f"impact {impact}", medium, origins, directions, *_through_ball(origins, directions))
    for plates in (_Plates.slab(), _Plates.prism()):
        medium = _body(plates.name, _polyhedron(trimesh.Trimesh(plates.corners).convex_hull, "flat"))
        for degrees in plates.degrees:
            rays = plates.rays(degrees, generator)
            yield _Case(plates.name, f"incidence {degrees}", medium, *rays, *plates.exits(*rays))
    medium = LuneburgLens()
    for impact in (0.2, 0.5, 0.8):
        origins, directions = _towards_ball(impact, generator)
        # The path in the lens is x0 cos(sigma) + d sin(sigma), up to sigma = pi / 2.
        along = (origins * directions).sum(-1, keepdim=True)
        entries = origins - (along + math.sqrt(1 - impact**2)) * directions
        yield _Case("luneburg", f"impact {impact}", medium, origins, directions, directions, -entries)


def _polyhedron(mesh: trimesh.Trimesh, shading: Literal["smooth", "flat"]) -> MeshSurface:
    return MeshSurface.of(make_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), shading)


def _body(name: str, surface: Surface) -> Bodies:
    return Bodies([Body(name, surface, Material(_IOR))], grid=GridSettings())


@dataclass(frozen=True)
class _Plates:
    """A body with two flat faces, which rays cross one after the other.

    Attributes:
        name: name of the body.
        corners: corners of the body.
        points, normals: a point on each of the two faces, and their outward normals.
        degrees: angles of incidence on the first face.
    """

    name: str
    corners: Float[np.ndarray, "corners 3"]
    points: Float[Tensor, "2 3"]
    normals: Float[Tensor, "2 3"]
    degrees: Sequence[int]

    @classmethod
    def slab(cls) -> _Plates:
        """Return a square plate, half as thick as its half side."""
        half = np.array([1.0, 1.0, 0.25])
        corners = half * np.array(list(itertools.product((-1, 1), repeat=3)))
        normals = torch.tensor([[0, 0, 1], [0, 0, -1]], dtype=torch.float64)
        return cls("slab", corners, half[2] * normals, normals, (20, 40, 60))

    @classmethod
    def prism(cls) -> _Plates:
        """Return an equilateral prism along y, whose edge points along z."""
        angles = np.deg2rad([90, 210, 330])
        corners = np.array([[math.cos(a), y, math.sin(a)] for a in angles for y in (-1, 1)])
        normals = torch.tensor([[-math.sqrt(3), 0, 1], [math.sqrt(3), 0, 1]], dtype=torch.float64) / 2
        return cls("prism", corners, 0.5 * normals, normals, (40, 50, 60))

    def rays(self, degrees: int, generator: torch.Generator) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
        """Return rays to points around the middle of the first face; those of a prism go towards the second."""
        slant = math.radians(degrees)
        normal, along = self.normals[0], torch.tensor([0, 1, 0], dtype=torch.float64)
        down = functional.normalize(torch.linalg.cross(along, normal), dim=0)
        down = down * torch.sign((self.normals[1] * down).sum()) if self.name == "prism" else down
        turn = 0.3 * torch.rand(_NUM_RAYS, 1, generator=generator, dtype=torch.float64)
        sideways = turn.cos() * down + turn.sin() * along
        directions = math.sin(slant) * sideways - math.cos(slant) * normal
        targets = self.points[0] + 0.1 * torch.rand(_NUM_RAYS, 1, generator=generator, dtype=torch.float64) * along
        return targets - 3 * directions, directions

    def exits(
        self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"]
    ) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
        """Refract rays at both faces by Snell's law."""
        for point, outward, ratio in zip(
            self.points, (-self.normals[0], self.normals[1]), (1 / _IOR, _IOR), strict=True
        ):
            cosine = (d * outward).sum(-1, keepdim=True)
            x = x + ((point - x) * outward).sum(-1, keepdim=True) / cosine * d
            d = ratio * d + ((1 - ratio**2 * (1 - cosine**2)).sqrt() - ratio * cosine) * outward
        return x, d


def angle(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the angle between unit vectors in degrees, exact for small ones."""
    return torch.rad2deg(2 * torch.asin((0.5 * torch.linalg.vector_norm(a.double() - b.double(), dim=-1)).clamp(max=1)))


def _towards_ball(impact: float, generator: torch.Generator) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Return rays from all sides that pass the origin at a distance."""
    first, second = torch.randn(2, _NUM_RAYS, 3, generator=generator, dtype=torch.float64)
    directions = functional.normalize(first, dim=-1)
    across = functional.normalize(torch.linalg.cross(directions, second), dim=-1)
    return impact * across - 3 * directions, directions


def _through_ball(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Turn rays by 2 (i - t), where sin i = b / R and sin t = b / (n R), around the centre of the ball."""
    nearest = origins - (origins * directions).sum(-1, keepdim=True) * directions
    impact = nearest.norm(dim=-1, keepdim=True)
    sine = impact / _RADIUS
    turn = 2 * (torch.asin(sine) - torch.asin(sine / _IOR))
    across = nearest / impact
    exit_directions = turn.cos() * directions - turn.sin() * across
    return impact * (turn.cos() * across + turn.sin() * directions), exit_directions
