"""Paths of rays through a continuous refractive index, by the Eikonal equation d/ds (n dx/ds) = grad n.

With v = n dx/ds the equation is x' = v / n, v' = grad n (paper, Eqn. 4), and |v| = n along every exact solution.
The module has the integrators of one step, the path sampler, and the tracers with equal and with adaptive steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal, NamedTuple

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path, Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.kernels.tolerances import STEPS_PER_SHELL
from nerfro.media.base import Medium
from nerfro.paper.compiled import eikonal_on_grid, uniform_on_grid
from nerfro.paper.tolerances import MIN_NORMAL_PART, MIN_TURN, REACHED, RESOLVED
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.registry.allowed import Count, OnlyWith, Positive
from nerfro.registry.registration import register
from nerfro.samplers.base import PathSampler
from nerfro.samplers.paths.polylines import distance_to_end
from nerfro.samplers.paths.replay import Vertices, assembled, is_interior, with_gradient

Index = Callable[[Tensor], tuple[Tensor, Tensor]]


class RayState(NamedTuple):
    """State of rays.

    Attributes:
        positions: positions in world units.
        velocities: v, the unit direction times the refractive index.
        n: refractive index at the positions.
        gradients: gradient of the index at the positions, per world unit.
    """

    positions: Float[Tensor, "R 3"]
    velocities: Float[Tensor, "R 3"]
    n: Float[Tensor, "R"]
    gradients: Float[Tensor, "R 3"]


Integrator = Callable[[RayState, Float[Tensor, "R"], Index], RayState]


def euler(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Take an explicit Euler step, x + ds v / n and v + ds grad n, both from the old state, as the paper does.

    |v| drifts away from n.
    """
    x, v, n, g = state
    x, v = x + (ds / n)[:, None] * v, v + ds[:, None] * g
    return RayState(x, v, *index(x))


def leapfrog(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Take a kick-drift-kick step with the force n grad n of dx/dsigma = v; second order, with one lookup of the index.

    dsigma = ds / n with the index in the middle of the step, n + ds/2 dn/ds, so that the step has length ds to second
    order. The step is exact where n^2 is linear in space.

    If a step does not resolve the index, so that |v| differs from n, and at the end of a varying index, the component
    of v along the kick is changed so that |v| = n. The component across the kick, n sin(angle) at a surface, is
    conserved by refraction, so a flat interface is refracted exactly in any number of steps. Steps that resolve the
    index are not corrected: their error of |v| does not accumulate, and mostly is not along the kick because the
    gradient turns. A small component along the kick, as of a ray that turns, is not determined by |v| = n.
    """
    _, v, n, g = state
    middle = n + 0.5 * ds * (g * v).sum(-1) / n
    x, kicked, n, g = kick_drift_kick(state, ds / torch.maximum(middle, 0.5 * state.n), index)
    varies = (g != 0).any(-1)
    return RayState(x, _with_length_along(kicked, kicked - v, n, varies), n, g)


def kick_drift_kick(state: RayState, dsigma: Float[Tensor, "R"], index: Index) -> RayState:
    """Take the step of `leapfrog` in the parameter sigma of dx/dsigma = v, dv/dsigma = n grad n.

    For a fixed dsigma, the step is a symplectic map, and its own inverse with reversed v.
    """
    x, v, n, g = state
    dsigma = dsigma[:, None]
    kicked = v + 0.5 * dsigma * n[:, None] * g
    x = x + dsigma * kicked
    n, g = index(x)
    return RayState(x, kicked + 0.5 * dsigma * n[:, None] * g, n, g)


def _with_length_along(
    v: Float[Tensor, "R 3"], axis: Float[Tensor, "R 3"], length: Float[Tensor, "R"], varies: Bool[Tensor, "R"]
) -> Float[Tensor, "R 3"]:
    """Change the component of v along an axis so that |v| equals `length`, under the conditions of `leapfrog`."""
    unit = functional.normalize(axis, dim=-1, eps=torch.finfo(v.dtype).tiny)
    along = (v * unit).sum(-1)
    excess = v.square().sum(-1) - length**2
    squared = along**2 - excess
    resolved = varies & (excess.abs() <= RESOLVED * length**2)
    sound = (torch.minimum(along**2, squared) >= MIN_NORMAL_PART * length**2) & ~resolved
    # Unused roots are taken of 1, because the root of a negative number would make gradients NaN.
    change = torch.copysign(torch.where(sound, squared, 1.0).sqrt(), along) - along
    return v + torch.where(sound, change, 0.0)[:, None] * unit


@register("sampler/path", "eikonal")
class Eikonal(PathSampler):
    """Trace rays by the Eikonal equation, with adaptive steps or with the equal Euler steps of the paper.

    Args:
        integrator: `adaptive` takes leapfrog steps where the index varies, jumps elsewhere, and keeps few vertices.
            `euler` takes equal steps from near to far and keeps all vertices, as the paper does.
        num_steps: number of vertices of a path of equal steps; 768 in the paper.
        tolerance: largest distance of an adaptive path from its polyline, as a fraction of the box's diagonal.
        max_steps: largest number of adaptive steps of a ray, after which the path continues straight.
    """

    def __init__(
        self,
        integrator: Literal["adaptive", "euler"] = "adaptive",
        num_steps: Annotated[int, Ge(2), Le(8192), OnlyWith("integrator", ("euler",))] = 768,
        tolerance: Annotated[Positive, OnlyWith("integrator", ("adaptive",))] = 2e-4,
        max_steps: Annotated[Count, OnlyWith("integrator", ("adaptive",))] = 16384,
    ) -> None:
        super().__init__()
        self.integrator, self.num_steps, self.tolerance, self.max_steps = integrator, num_steps, tolerance, max_steps
        self.ends_at_far = integrator == "euler"

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace rays from near to far; bent adaptive paths end outside the medium's box, beyond far if necessary."""
        if medium.absorption is not None or medium.disperses:
            raise NerfroError("medium.absorption and medium.abbe need sharp surfaces; take sampler/path=snell")
        if self.integrator != "adaptive":
            if isinstance(medium, VoxelGrid):
                return uniform_on_grid(rays, medium, self.num_steps)
            return march_uniform(rays, medium, euler, self.num_steps)
        tolerance = self.tolerance * float(torch.linalg.vector_norm(medium.box[1] - medium.box[0]))
        if isinstance(medium, VoxelGrid):
            return eikonal_on_grid(rays, medium, 0.5 * float(medium.spacing.min()), tolerance, self.max_steps)
        if _has_grids(medium):
            step = 2 * medium.bodies.shell / STEPS_PER_SHELL
            return eikonal_on_grid(rays, medium.bodies, step, tolerance, self.max_steps)
        return march_adaptive(rays, medium, tolerance, self.max_steps)

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        """Repeat the steps of a path with gradients with respect to rays and medium, and keep the states of all steps.

        At a thin shell, gradients grow without bound towards grazing and critical angles, as at a sharp surface.
        """
        if self.integrator == "adaptive":
            return replay_adaptive(path, rays, medium, self.max_steps)
        rays = rays[path.ray]
        replayed = march_uniform(rays, medium, euler, self.num_steps)
        names = ("positions", "directions", "s")
        columns: dict[str, Any] = {n: with_gradient(getattr(path, n), getattr(replayed, n)) for n in names}
        return replace(path, **columns)

    def releases_gil(self, medium: Medium) -> bool:
        return isinstance(medium, VoxelGrid) or (self.integrator == "adaptive" and _has_grids(medium))


def _has_grids(medium: Medium) -> bool:
    """Return whether the medium consists of bodies on grids, which the kernel reads."""
    return medium.bodies is not None and len(medium.bodies.grids) > 0


def march_uniform(rays: Rays, medium: Medium, integrator: Integrator, num_steps: int) -> Path:
    """Trace rays by equal steps ds = (far - near) / (num_steps - 1) (paper, Eqn. 4).

    The arc length of a vertex is the length of the polyline. At near, v = n d.
    """
    ds = (rays.far - rays.near) / (num_steps - 1)
    x = rays.origins + rays.near[:, None] * rays.directions
    n, gradients = medium(x)
    state = RayState(x, n[:, None] * rays.directions, n, gradients)
    states = [state]
    for _ in range(num_steps - 1):
        state = integrator(state, ds, medium)
        states.append(state)
    positions = torch.stack([state.positions for state in states], 1)
    velocities = torch.stack([state.velocities for state in states], 1)
    directions = velocities / velocities.norm(dim=-1, keepdim=True)
    lengths = (positions[:, 1:] - positions[:, :-1]).norm(dim=-1)
    s = torch.cat([rays.near[:, None], rays.near[:, None] + lengths.cumsum(-1)], -1)
    refracted = torch.stack([(state.gradients != 0).any(-1) for state in states], -1).any(-1)
    return Path.unbranched(positions, directions, s, refracted, rays.radii)


class _NewVertices:
    """Vertices of a trace: recorded where a path is far from its last tangent, and at the start of jumps."""

    def __init__(self, rays: Rays, tolerance: float) -> None:
        self.kept, self.tolerance = _start(rays), tolerance
        self.counts = torch.zeros(len(rays), dtype=torch.long, device=rays.near.device)
        self.found: list[Vertices] = []
        self._keep(torch.arange(len(rays), device=rays.near.device), *_start(rays))

    def before_jump(self, rows: Tensor, x: Tensor, d: Tensor, s: Tensor) -> None:
        self._keep(rows[(d[rows] - self.kept[1][rows]).square().sum(-1) > MIN_TURN], x, d, s)

    def after_step(self, rows: Tensor, length: Tensor, x: Tensor, d: Tensor, s: Tensor) -> None:
        kept_x, kept_d, kept_s = (values[rows] for values in self.kept)
        tangent = kept_x + (s[rows] - kept_s)[:, None] * kept_d
        self._keep(rows[(x[rows] - tangent).square().sum(-1) > self.tolerance**2], x, d, s)

    def _keep(self, rows: Tensor, *state: Tensor) -> None:
        x, d, s = (values[rows] for values in state)
        self.found.append((rows, self.counts[rows], x, d, s))
        self.counts[rows] += 1
        for kept, values in zip(self.kept, (x, d, s), strict=True):
            kept[rows] = values

    def path(self, rays: Rays, box: Tensor, refracted: Tensor, x: Tensor, d: Tensor, s: Tensor) -> Path:
        """Return the paths from the last states; short rows repeat the last vertex."""
        ahead = distance_to_end(rays.far, box, refracted, x, d, s)
        rows = torch.arange(len(rays), device=s.device)
        self._keep(rows, x + ahead[:, None] * d, d, s + ahead)
        vertices = s.new_zeros(len(rays), int(self.counts.max()) if len(rays) else 2, 7)
        for found, column, *state in self.found:
            positions, directions, lengths = state
            vertices[found, column] = torch.cat([positions, directions, lengths[:, None]], -1)
        index = torch.arange(vertices.shape[1], device=s.device).minimum(self.counts[:, None] - 1)[..., None]
        positions, directions, lengths = vertices.take_along_dim(index, 1).split((3, 3, 1), -1)
        return Path.unbranched(positions, directions, lengths[..., 0], refracted, rays.radii)


class _KnownVertices:
    """Vertices of a replay: at the arc lengths of the traced vertices."""

    def __init__(self, path: Path) -> None:
        self.s, self.last = path.s, is_interior(path).sum(-1)
        self.next = torch.ones_like(path.ray)
        self.found: list[Vertices] = []

    def before_jump(self, rows: Tensor, x: Tensor, d: Tensor, s: Tensor) -> None:
        """Do nothing: the vertex at the start of a jump is at the end of the previous step."""

    def after_step(self, rows: Tensor, length: Tensor, x: Tensor, d: Tensor, s: Tensor) -> None:
        column = self.next[rows]
        # A vertex lies at the end of a step; rounding errors must not move the vertex to the next step.
        due = (column <= self.last[rows]) & (s[rows] >= self.s[rows, column] - 0.01 * length)
        rows, column = rows[due], column[due]
        self.found.append((rows, column, x[rows], d[rows], s[rows]))
        self.next[rows] += 1


def march_adaptive(rays: Rays, medium: Medium, tolerance: float, max_steps: int) -> Path:
    """Trace rays by leapfrog steps where the index varies and by straight jumps elsewhere.

    This is the reference implementation of the compiled kernel. A vertex is recorded when the path is more than
    `tolerance` world units from the tangent of the last vertex, and at the start of jumps. After `max_steps` steps, the
    path continues straight.
    """
    vertices = _NewVertices(rays, tolerance)
    state, refracted = _march(rays, medium, max_steps, vertices)
    vertices.before_jump(torch.arange(len(rays), device=rays.near.device), *state)
    return vertices.path(rays, medium.box, refracted, *state)


def replay_adaptive(path: Path, rays: Rays, medium: Medium, max_steps: int) -> Path:
    """Repeat the steps of `march_adaptive` with gradients with respect to rays and medium, including the step lengths.

    The precision is double, as in the compiled kernel. The backward pass needs the states of all steps.
    """
    precise = rays[path.ray].to(torch.float64)
    vertices = _KnownVertices(path)
    state, _ = _march(precise, medium, max_steps, vertices)
    rows = torch.arange(len(precise), device=path.s.device)
    first = (rows, torch.zeros_like(rows), *_start(precise))
    return assembled(path, rays, medium, [first, *vertices.found], state)


def _start(rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    return rays.origins + rays.near[:, None] * rays.directions, rays.directions.clone(), rays.near.clone()


def _march(
    rays: Rays, medium: Medium, max_steps: int, vertices: _NewVertices | _KnownVertices
) -> tuple[tuple[Tensor, Tensor, Tensor], Bool[Tensor, "R"]]:
    """Trace rays until they leave the medium's box; outside the box, rays are straight.

    Inside the box, a ray jumps by the clearance of the medium if there is any, and otherwise takes a leapfrog step.

    Returns:
        Last positions, directions and arc lengths; whether the index varied on the path.
    """
    num_rays = len(rays)
    rows = torch.arange(num_rays, device=rays.near.device)
    x, d, s = _start(rays)
    refracted = torch.zeros(num_rays, dtype=torch.bool, device=x.device)
    enter, leave = intersect_box(medium.box, x, d)
    active = rows[(enter < leave) & (leave > 0) & (enter < rays.far - s)]
    jump = enter[active].clamp(min=0)
    x[active] += jump[:, None] * d[active]
    s[active] += jump
    # Tensors of all rays are changed in place, so autograd must save only tensors of selected rows.
    n, g, v = torch.ones_like(s), torch.zeros_like(x), torch.zeros_like(x)
    n[active], g[active] = medium(x[active])
    v[active] = n[active, None] * d[active]
    for _ in range(max_steps):
        if not len(active):
            break
        step = medium.step_length(d[active], g[active])
        free = medium.clearance(x[active])
        jumps = free > REACHED * step
        jumping, stepping = active[jumps], active[~jumps]
        vertices.before_jump(jumping, x, d, s)
        length = free[jumps]
        x[jumping] += length[:, None] * d[jumping]
        s[jumping] += length
        n[jumping], g[jumping] = medium(x[jumping])
        v[jumping] = n[jumping, None] * d[jumping]
        varies = (g[stepping] != 0).any(-1)
        refracted[stepping] |= varies
        ds = step[~jumps]
        state = leapfrog(RayState(x[stepping], v[stepping], n[stepping], g[stepping]), ds, medium)
        length = torch.linalg.vector_norm(state.positions - x[stepping], dim=-1)
        s[stepping] += length
        x[stepping], v[stepping], n[stepping], g[stepping] = state
        # A straight step must not change the direction by rounding, but a replay needs the gradients of the direction.
        bent = stepping if v.requires_grad else stepping[varies | (state.gradients != 0).any(-1)]
        d[bent] = torch.nn.functional.normalize(v[bent], dim=-1)
        vertices.after_step(stepping, length, x, d, s)
        outside = ((x[active] < medium.box[0]) | (x[active] > medium.box[1])).any(-1)
        active = active[~outside]
    return (x, d, s), refracted
