"""Modules with one thing changed, and the rest shared with the original."""

from __future__ import annotations

import copy
from typing import TypeVar

from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)


def variant(module: Module, **changes: object) -> Module:
    """A module like the given one but for some attributes; it shares all others, and the original stays as it is.

    A tensor becomes a buffer, also where the original has a parameter.
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
