"""Base class of components whose settings may depend on the training views."""

from __future__ import annotations

from typing import Any, ClassVar

from omegaconf import DictConfig

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
