"""Networks of fields: compilation by torch.compile, and the activation of radiance."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError

# Activation whose squared sigmoid is 1 / 240 in sRGB.
_BLACK = -4.0


class Network(nn.Module):
    """Base class of networks that `compile=` compiles as a whole; a `Sequential` needs no base class."""


def compile_networks(model: nn.Module, backend: str) -> None:
    """Compile a model's networks in place with torch.compile, for any number of points."""
    backends = torch.compiler.list_backends(exclude_tags=())
    if backend not in backends:
        raise NerfroError(f"compile={backend} is not a backend of torch.compile; set one of {', '.join(backends)}")
    for module in model.modules():
        if isinstance(module, (Network, nn.Sequential)):
            module.compile(backend=backend, dynamic=True)


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
