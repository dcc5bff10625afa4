"""Copies of modules with changed attributes, which share all other attributes."""

from __future__ import annotations

import copy
from typing import TypeVar

from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)


def variant(module: Module, **changes: object) -> Module:
    """Copy a module with some attributes replaced; the copy shares all other attributes.

    A tensor becomes a buffer, even if the original has a parameter of the name.
    """
    changed = copy.copy(module)
    for registry in ("_parameters", "_buffers", "_modules"):
        changed.__dict__[registry] = dict(getattr(module, registry))
    for name, value in changes.items():
        if isinstance(value, Tensor):
            changed._parameters.pop(name, None)
            changed.register_buffer(name, value, persistent=False)
        else:
            setattr(changed, name, value)
    return changed
