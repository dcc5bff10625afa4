"""Layers and activations of fields and backgrounds, and their compilation by torch.compile."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.errors import NerfroError
from nerfro.kernels.linear import Linear

# Colours extend slightly beyond [0, 1], so that black and white need no infinite activation (mip-NeRF's code).
RGB_PADDING = 1e-3
# Activation whose squared sigmoid is 1 / 240 in sRGB.
_BLACK = -4.0


class SkipMLP(nn.Module):
    """ReLU layers with a skip connection: the input is concatenated to the output of layer `skip` (counted from 1).

    Weights are Glorot-uniform and biases are zero, as in the authors' code.
    """

    def __init__(self, num_inputs: int, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self.skip = skip
        inputs = [num_inputs] + [width + num_inputs * (i == skip) for i in range(1, depth)]
        self.layers = nn.ModuleList(glorot_linear(n, width) for n in inputs)
        self.num_outputs = width + num_inputs * (skip == depth)

    def forward(self, x: Float[Tensor, "*batch I"]) -> Float[Tensor, "*batch O"]:
        batch = x.shape[:-1]
        y = x = x.reshape(-1, x.shape[-1]).to(self.layers[0].weight.dtype)  # type: ignore[arg-type]
        for i, layer in enumerate(self.layers, start=1):
            y = F.relu(layer(y, x) if i == self.skip + 1 else layer(y), inplace=True)
        if self.skip == len(self.layers):
            y = torch.cat([y, x.to(y.dtype)], dim=-1)
        return y.view(*batch, self.num_outputs)


class Network(nn.Module):
    """Base class of networks that `compile=` compiles as a whole; a `Sequential` needs no base class."""


def compile_networks(model: nn.Module, backend: str) -> None:
    """Compile a model's networks in place with torch.compile, for any number of points."""
    known = torch.compiler.list_backends(exclude_tags=())
    if backend not in known:
        raise NerfroError(f"compile={backend} is not a backend of torch.compile; set one of {', '.join(known)}")
    for module in model.modules():
        if isinstance(module, (Network, nn.Sequential)):
            module.compile(backend=backend, dynamic=True)


def glorot_linear(num_inputs: int, num_outputs: int) -> nn.Linear:
    """Create a linear layer with Glorot-uniform weights and zero bias."""
    layer = Linear(num_inputs, num_outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def padded_sigmoid(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Evaluate a sigmoid with range [-0.001, 1.001] in single precision."""
    return torch.sigmoid(raw.float()) * (1 + 2 * RGB_PADDING) - RGB_PADDING


def radiance(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Convert raw outputs to linear radiance in [0, 1] by a squared sigmoid.

    The square approximates sRGB, which stores about the root of radiance. Early in training, black explains thin fog in
    front of a bright sky best, and the gradient of a saturated sigmoid would vanish. Therefore gradients that would
    decrease values below `_BLACK`, the smallest pixel value above 0, are blocked.
    """
    return torch.sigmoid(_ClampBlack.apply(raw.float())).square()


class _ClampBlack(torch.autograd.Function):
    """Clamp values at `_BLACK`; below, pass only gradients that increase the values."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        return raw.clamp(min=_BLACK)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (raw,) = ctx.saved_tensors
        return torch.where((raw < _BLACK) & (gradient > 0), 0.0, gradient)
