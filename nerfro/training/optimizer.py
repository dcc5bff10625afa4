"""Settings of Adam and of the learning rate, and groups of parameters by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated

from torch import nn

from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import Natural, NotNegative, OnlyWith, Positive, validated

# Patterns that have no effect in a scene without these parameters.
OPTIONAL_PATTERNS = (
    "background.*", "bodies.*.material.ior", "bodies.*.material.absorption", "cameras.*", "cameras.exposure",
)  # fmt: skip
# Name of the group of all parameters that no pattern matches.
COMMON = "common"


@validated("optimizer.groups")
@dataclass
class GroupConfig:
    """Settings of all parameters whose names match a pattern.

    Attributes:
        learning_rate: initial learning rate; None for the common rate.
        start: step at which the parameters begin to learn; None for the step that the component of a run needs
            (`Component.learns_from`), which is 0 except for a background that a phase fits first.
    """

    learning_rate: Positive | None = None
    start: Natural | None = None


@validated("optimizer")
@dataclass
class OptimizerConfig:
    """Adam with a log-linear learning rate and a sine warm-up (authors' code; mip-NeRF, section 4).

    The defaults are those of the paper; conf/train.yaml changes them.

    Attributes:
        learning_rate: initial learning rate.
        final_learning_rate: learning rate at the end of the run.
        groups: learning rate and start of parameters by the pattern of their names
            (`Scene.parameters_by_name`), in which an asterisk stands for any text: {bodies.*.material.ior:
            {learning_rate: 1e-3, start: 100}}. The rates have the same decay. Of several matching patterns the
            last one decides.
        warmup_steps: length of the warm-up; 0 for none.
        warmup_factor: factor of the learning rate at its first step.
        adam_epsilon: epsilon of Adam.
    """

    learning_rate: Positive = 5e-4
    final_learning_rate: Positive = 5e-6
    groups: dict[str, GroupConfig] = dataclasses.field(default_factory=dict)
    warmup_steps: Natural = 2500
    warmup_factor: Annotated[NotNegative, OnlyWith("warmup_steps")] = 0.01
    adam_epsilon: Positive = 1e-8

    def __post_init__(self) -> None:
        self.groups = {
            pattern: group if isinstance(group, GroupConfig) else GroupConfig(**group)
            for pattern, group in self.groups.items()
        }

    def group(self, name: str) -> GroupConfig:
        """Return the settings of a group of `grouped`."""
        return self.groups.get(name, GroupConfig())

    def grouped(self, parameters: Mapping[str, nn.Parameter]) -> dict[str, list[nn.Parameter]]:
        """Group parameters by the last pattern that matches their names; the others are in the group `COMMON`.

        Args:
            parameters: parameters by name.

        Raises:
            NerfroError: a pattern matches no parameter.
        """
        require_matches("optimizer.groups", self.groups, parameters)
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in parameters.items():
            matching = (pattern for pattern in reversed(self.groups) if fnmatchcase(name, pattern))
            groups.setdefault(next(matching, COMMON), []).append(parameter)
        return groups


def require_matches(where: str, patterns: Iterable[str], names: Iterable[str]) -> None:
    """Refuse patterns that match no name of a parameter, unless they are in `OPTIONAL_PATTERNS`.

    Args:
        where: start of the error message.
        patterns: patterns of names, in which an asterisk stands for any text.
        names: names of all learned parameters.

    Raises:
        NerfroError: a pattern matches no parameter.
    """
    learned = list(names)
    for pattern in patterns:
        if pattern not in OPTIONAL_PATTERNS and not any(fnmatchcase(name, pattern) for name in learned):
            raise NerfroError(
                f"{where}: {pattern} matches no learned parameter; choose from {', '.join(learned) or 'none'}, with * "
                "for any text"
            )
