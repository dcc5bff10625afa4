"""Check of the results of components, which names the file of a plugin whose result breaks its contract."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any

from nerfro.core.errors import NerfroError


def require_results(cls: Any, expected: type, contract: str, fits: Callable[[Any, Any], bool]) -> None:
    """Let `forward` of a class check its result.

    Args:
        cls: subclass of a base class of plugins.
        expected: type of the result.
        contract: what `forward` returns, with shapes, for the message.
        fits: whether a result of this type fits the first argument of `forward`.
    """
    forward = vars(cls).get("forward")
    if forward is None or getattr(forward, "__isabstractmethod__", False):
        return

    @functools.wraps(forward)
    def checked(self: Any, inputs: Any, *others: Any, **options: Any) -> Any:
        result = forward(self, inputs, *others, **options)
        if isinstance(result, expected) and fits(result, inputs):
            return result
        shape = getattr(result, "shape", None)
        returned = f"a {type(result).__name__}" + ("" if shape is None else f" of shape {list(shape)}")
        if isinstance(result, expected) and shape is None:
            returned += " of other shapes"
        file = getattr(sys.modules.get(cls.__module__), "__file__", None) or cls.__module__
        raise NerfroError(f"{cls.__qualname__}.forward in {file} returned {returned}; return {contract}")

    cls.forward = checked
