"""Base class of components whose settings may depend on the training views, and check of their results."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, ClassVar

from omegaconf import DictConfig

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.geometry.space import Space


class Component:
    """Component of a training. Models, fields, point samplers, backgrounds and losses derive from this class.

    Attributes:
        needs_box: whether the component needs a space with a box, for example because it stores a grid over the space.
    """

    needs_box: ClassVar[bool] = False

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        """Derive values of settings of this component from the data.

        They replace only settings that are None, and the configuration of the run records them.

        Args:
            settings: all settings of the run as given, see `TrainConfig`.
            views: training views.
            space: space of the run.

        Returns:
            Values by the names of constructor parameters.
        """
        return {}

    @classmethod
    def learns_from(cls, settings: DictConfig) -> int:
        """Return the training step at which gradient descent begins to change the parameters of this component.

        A component that a phase fits before the first training step may return a later step. The result replaces a
        `start` in `optimizer.groups` that is None.

        Args:
            settings: all settings of the run, see `TrainConfig`.
        """
        return 0


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
