"""Compilation of the networks of fields by torch.compile."""

from __future__ import annotations

import torch
from torch import nn

from nerfro.core.errors import NerfroError


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
