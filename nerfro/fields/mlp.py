"""The NeRF MLP: a trunk for density and a view-dependent branch for colour."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.allowed import Count, checked
from nerfro.errors import NerfroError

# Colours reach a little beyond [0, 1], so that black and white need no infinite activation (mip-NeRF's code).
RGB_PADDING = 1e-3
# The squared sigmoid of this is 1 / 240 in sRGB.
_BLACK = -4.0


@checked("MLP")
class SkipMLP(nn.Module):
    """ReLU layers; the input is concatenated again to the output of layer `skip` (counted from 1).

    Weights are Glorot-uniform and biases zero, as in the authors' code.
    """

    def __init__(self, num_inputs: int, width: Count, depth: Count, skip: int) -> None:
        super().__init__()
        self.skip = skip
        inputs = [num_inputs] + [width + num_inputs * (i == skip) for i in range(1, depth)]
        self.layers = nn.ModuleList(glorot_linear(n, width) for n in inputs)
        self.num_outputs = width + num_inputs * (skip == depth)

    def forward(self, x: Float[Tensor, "*batch I"]) -> Float[Tensor, "*batch O"]:
        y = x = x.to(self.layers[0].weight.dtype)  # type: ignore[arg-type]  # rays are in single precision
        for i, layer in enumerate(self.layers, start=1):
            y = F.relu(layer(y))
            if i == self.skip:
                y = torch.cat([y, x.to(y.dtype)], dim=-1)
        return y


class RadianceMLP(nn.Module):
    """Encoded position and direction -> density (softplus of raw - 1) and colour (padded sigmoid).

    Args:
        num_position, num_direction: widths of the encodings.
        width, depth, skip: of the trunk; NeRF's are 256, 8 and 5.
        view_width: of the layer that mixes in the direction.
    """

    def __init__(
        self, num_position: int, num_direction: int, width: int, depth: int, skip: int, view_width: int
    ) -> None:
        super().__init__()
        self.trunk = SkipMLP(num_position, width, depth, skip)
        self.density = glorot_linear(self.trunk.num_outputs, 1)
        self.bottleneck = glorot_linear(self.trunk.num_outputs, width)
        self.view = glorot_linear(width + num_direction, view_width)
        self.rgb = glorot_linear(view_width, 3)

    def forward(
        self, position: Float[Tensor, "*batch P"], direction: Float[Tensor, "*batch D"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        features = self.trunk(position)
        density = F.softplus(self.density(features).squeeze(-1).float() - 1.0)
        view = F.relu(self.view(torch.cat([self.bottleneck(features), direction.to(features.dtype)], dim=-1)))
        return density, padded_sigmoid(self.rgb(view))


def compile_networks(model: nn.Module, backend: str) -> None:
    """Have torch.compile compile a model's networks in place, for any number of points."""
    known = torch.compiler.list_backends(exclude_tags=())
    if backend not in known:
        raise NerfroError(f"compile={backend} is no backend of torch.compile here; there are {', '.join(known)}")
    for module in model.modules():
        if isinstance(module, (RadianceMLP, nn.Sequential)):
            module.compile(backend=backend, dynamic=True)


def glorot_linear(num_inputs: int, num_outputs: int) -> nn.Linear:
    """Linear layer with Glorot-uniform weights and zero bias."""
    layer = nn.Linear(num_inputs, num_outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def padded_sigmoid(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Sigmoid stretched to [-0.001, 1.001], in single precision."""
    return torch.sigmoid(raw.float()) * (1 + 2 * RGB_PADDING) - RGB_PADDING


def radiance(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Linear radiance in [0, 1]: a squared sigmoid, for pictures store about the root of radiance.

    Thin fog before a bright sky is soonest explained by black, and a sigmoid that was driven far down would never come
    back: below `_BLACK`, a pixel's last level above 0, nothing drives it on.
    """
    return torch.sigmoid(_HeldBack.apply(raw.float())).square()


class _HeldBack(torch.autograd.Function):
    """The identity, cut off at `_BLACK`; there it passes the gradients alone that lead back."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        return raw.clamp(min=_BLACK)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (raw,) = ctx.saved_tensors
        return torch.where((raw < _BLACK) & (gradient > 0), 0.0, gradient)
