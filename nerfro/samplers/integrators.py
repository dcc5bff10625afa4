"""One step of the Eikonal equation in arc length, d/ds (n dx/ds) = grad n.

With v = n dx/ds the equation is x' = v / n, v' = grad n (paper, Eqn. eikonal), and |v| = n along every exact solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

Index = Callable[[Tensor], tuple[Tensor, Tensor]]


class RayState(NamedTuple):
    """Where rays are.

    Attributes:
        positions: world units.
        velocities: v, direction times refractive index.
        n, gradients: the medium there.
    """

    positions: Float[Tensor, "R 3"]
    velocities: Float[Tensor, "R 3"]
    n: Float[Tensor, "R"]
    gradients: Float[Tensor, "R 3"]


Integrator = Callable[[RayState, Float[Tensor, "R"], Index], RayState]


def euler(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Explicit Euler, x + ds v / n, v + ds grad n, both from the old state (the paper's); |v| drifts away from n."""
    x, v, n, g = state
    x, v = x + (ds / n)[:, None] * v, v + ds[:, None] * g
    return RayState(x, v, *index(x))


def leapfrog(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Kick, drift, kick with the force n grad n of dx/dsigma = v, dsigma = ds / n; second order, one lookup a step.

    Exact where n^2 is linear in space. The length of v is set to n after the step, as the Eikonal equation demands.
    """
    x, v, n, g = state
    dsigma = (ds / n)[:, None]
    v = v + 0.5 * dsigma * n[:, None] * g
    x = x + dsigma * v
    n, g = index(x)
    v = v + 0.5 * dsigma * n[:, None] * g
    return RayState(x, with_length(v, n), n, g)


def rk4(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """The classical fourth-order Runge-Kutta step; the length of v is set to n after it."""
    x, v, n, g = state
    ds = ds[:, None]
    x1, v1 = v / n[:, None], g
    n2, v2 = index(x + 0.5 * ds * x1)
    x2 = (v + 0.5 * ds * v1) / n2[:, None]
    n3, v3 = index(x + 0.5 * ds * x2)
    x3 = (v + 0.5 * ds * v2) / n3[:, None]
    n4, v4 = index(x + ds * x3)
    x4 = (v + ds * v3) / n4[:, None]
    x = x + ds / 6 * (x1 + 2 * x2 + 2 * x3 + x4)
    v = v + ds / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
    n, g = index(x)
    return RayState(x, with_length(v, n), n, g)


def with_length(v: Float[Tensor, "R 3"], length: Float[Tensor, "R"]) -> Float[Tensor, "R 3"]:
    """Vectors of the same direction and the given length."""
    return v * (length / v.norm(dim=-1))[:, None]


INTEGRATORS: dict[str, Integrator] = {"euler": euler, "leapfrog": leapfrog, "rk4": rk4}
