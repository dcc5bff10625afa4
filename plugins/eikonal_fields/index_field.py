"""A learned refractive index inside a box."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.paths import resolve_path
from nerfro.geometry.mesh import load_mesh, local_origin
from nerfro.geometry.space import corners_of_box, inside_box
from nerfro.media.base import Medium
from nerfro.registry.allowed import Depth, Natural, Positive, Width
from nerfro.registry.registration import register

# Sharpness of the activation (authors' code): the Eikonal equation needs a smooth one, not ReLU.
_BETA = 5.0


@register("medium", "index_field")
class IndexField(Medium):
    """Represent the refractive index inside a box by an MLP of encoded positions, with n = 1 initially.

    As in the authors' code, a window multiplies the gradient of the network. It is 1 within the bounds of the content
    and decreases to 0 in a margin, so that the faces of the box do not refract. Images then determine the index up to a
    constant. The constant is chosen such that n = 1 on average over 26 points on the faces of the box.

    Value and gradient are both propagated forward through the layers, so that one backward pass trains both.

    Args:
        mesh: surface whose bounds are the bounds of the content; None for `box_min` and `box_max`.
        box_min, box_max: corners of the bounds of the content, world units.
        margin: width of the window around the bounds, as a fraction of the longest side.
        width, depth: width and number of hidden layers of the MLP.
        skip: layer, counted from 1, after which the encoding is concatenated again.
        octaves: number of octaves of the positional encoding; half the longest side has the length 1.
        ior: ignored, because the index is learned. Scene files set the index for other media.

    Raises:
        NerfroError: the box is empty.
    """

    box: Float[Tensor, "2 3"]
    bounds: Float[Tensor, "2 3"]
    frame: Float[Tensor, "26 3"]
    frequencies: Float[Tensor, " frequencies"]

    def __init__(
        self,
        mesh: str | None = None,
        box_min: Sequence[float] = (-1.0, -1.0, -1.0),
        box_max: Sequence[float] = (1.0, 1.0, 1.0),
        margin: Positive = 0.1,
        width: Width = 64,
        depth: Depth = 6,
        skip: Natural = 4,
        octaves: Natural = 5,
        ior: float | None = None,
    ) -> None:
        super().__init__()
        if mesh is not None:
            surface = load_mesh(resolve_path(mesh), accept_open_mesh=True)
            self.origin = local_origin(surface.vertices)
            box_min, box_max = (surface.bounds - self.origin).tolist()
        bounds = torch.from_numpy(corners_of_box(box_min, box_max)).float()
        side = float((bounds[1] - bounds[0]).max())
        self.fade, self.scale, self.skip = margin * side, 0.5 * side, skip
        self.register_buffer("bounds", bounds, persistent=False)
        self.register_buffer("box", bounds + self.fade * torch.tensor([[-1.0], [1.0]]), persistent=False)
        ticks = torch.tensor([-1.0, 0.0, 1.0])
        signs = torch.cartesian_prod(ticks, ticks, ticks)
        frame = self.box.mean(0) + 0.5 * signs[signs.any(-1)] * (self.box[1] - self.box[0])
        self.register_buffer("frame", frame, persistent=False)
        self.register_buffer("frequencies", 2.0 ** torch.arange(octaves), persistent=False)
        encoded = 3 * (1 + 2 * octaves)
        inputs = [encoded] + [width + encoded * (i == skip) for i in range(1, depth + 1)]
        self.layers = nn.ModuleList(_Dual(n, width) for n in inputs[:-1])
        self.last = _Dual(inputs[-1], 1)
        nn.init.zeros_(self.last.weight)

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the content, without the margin."""
        return self.bounds

    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Evaluate the refractive index and the gradient; the network is evaluated only inside the box."""
        flat = positions.reshape(-1, 3)
        index = inside_box(flat, *self.box).nonzero().squeeze(1)
        inside = flat[index]
        network, slope = self._network(inside)
        window = self._window(inside)
        excess = network - self._network(self.frame)[0].mean()
        n = torch.ones_like(flat[:, 0]).index_copy(0, index, (1 + window * excess).to(flat))
        gradients = torch.zeros_like(flat).index_copy(0, index, (window[:, None] * slope).to(flat))
        return n.view(positions.shape[:-1]), gradients.view(positions.shape)

    def _network(
        self, positions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate the index up to a constant, and the gradient."""
        encoded = self._encode(positions)
        state = encoded
        for i, layer in enumerate(self.layers, start=1):
            state = _softplus(layer(state))
            if i == self.skip:
                state = torch.cat([state, encoded], -1)
        state = _softplus(self.last(state))[..., 0]
        return state[:, 0], state[:, 1:] / self.scale

    def _encode(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 4 F"]:
        """Compute the positional encoding and the derivatives along the axes of the unit frame."""
        unit = ((positions - self.bounds.mean(0)) / self.scale).to(self.frequencies)
        angles = (unit[:, None] * self.frequencies[:, None]).flatten(1)
        rates = self.frequencies.repeat_interleave(3)
        sines, cosines = torch.sin(angles), torch.cos(angles)
        value = torch.cat([unit, sines, cosines], -1)
        slope = torch.cat([torch.ones_like(unit), rates * cosines, -rates * sines], -1)
        axes = torch.eye(3, device=unit.device).repeat(1, value.shape[1] // 3)
        return torch.cat([value[:, None], slope[:, None] * axes], 1)

    def _window(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Compute the window, a product of one cubic step per axis."""
        depth = 0.5 * (self.box[1] - self.box[0]) - (positions - self.bounds.mean(0)).abs()
        t = (depth / self.fade).clamp(0, 1)
        return (t * t * (3 - 2 * t)).prod(-1)


class _Dual(nn.Linear):
    """Linear layer for a value and three derivatives, which have no bias; weights are Glorot-uniform initially."""

    def reset_parameters(self) -> None:
        nn.init.xavier_uniform_(self.weight)
        nn.init.zeros_(self.bias)

    def forward(self, state: Float[Tensor, "points 4 I"]) -> Float[Tensor, "points 4 O"]:
        product = state @ self.weight.T
        return torch.cat([product[:, :1] + self.bias, product[:, 1:]], 1)


def _softplus(state: Float[Tensor, "points 4 O"]) -> Float[Tensor, "points 4 O"]:
    """Apply softplus to a value and three derivatives."""
    value, slopes = state[:, :1], state[:, 1:]
    return torch.cat([F.softplus(value, _BETA), torch.sigmoid(_BETA * value) * slopes], 1)
