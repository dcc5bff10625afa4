"""Settings of the optimizer and of the learning rate, and groups of parameters by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

import torch
from torch import nn

from nerfro.core.errors import NerfroError
from nerfro.core.joint_optimizer import JointOptimizer
from nerfro.registry.allowed import Natural, NotNegative, OnlyWith, Positive, validated

# Patterns that have no effect in a scene without these parameters.
OPTIONAL_PATTERNS = (
    "background.*", "bodies.*.material.ior", "bodies.*.material.absorption", "cameras.*", "cameras.exposure",
)  # fmt: skip
# Name of the group of all parameters that no pattern matches.
COMMON = "common"


OptimizerName = Literal["adam", "adamw", "sgd", "radam", "muon"]
_CLASSES: dict[str, type[torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "sgd": torch.optim.SGD, "radam": torch.optim.RAdam,
    **({"muon": torch.optim.Muon} if hasattr(torch.optim, "Muon") else {}),
}  # fmt: skip
# Entries of the state of an optimizer with one number for each parameter.
MOMENTS = dict.fromkeys(_CLASSES, ("exp_avg", "exp_avg_sq")) | {"sgd": (), "muon": ("momentum_buffer",)}


@validated("optimizer.groups")
@dataclass
class GroupConfig:
    """Settings of all parameters whose names match a pattern.

    Attributes:
        learning_rate: initial learning rate; None for the common rate.
        start: step at which the parameters begin to learn; None for the step that the component of a run needs
            (`Component.learns_from`), which is 0 except for a background that a phase fits first.
        name: optimizer of PyTorch; None for the common one.
    """

    learning_rate: Positive | None = None
    start: Natural | None = None
    name: OptimizerName | None = None


def _default_groups() -> dict[str, GroupConfig]:
    return {"background.*": GroupConfig(learning_rate=2e-3)}


@validated("optimizer")
@dataclass
class OptimizerConfig:
    """Optimizer of PyTorch with a log-linear learning rate and a sine warm-up (authors' code; mip-NeRF, section 4).

    The defaults are those of the default experiment. The experiments `paper_*` have the values of the paper.

    Attributes:
        name: optimizer of PyTorch, whose other settings have PyTorch's defaults.
        learning_rate: initial learning rate.
        final_learning_rate: learning rate at the end of the run.
        groups: learning rate and start of parameters by the pattern of their names
            (`Scene.parameters_by_name`), in which an asterisk stands for any text: {bodies.*.material.ior:
            {learning_rate: 1e-3, start: 100}}. The rates have the same decay. Of several matching patterns the
            last one decides.
        warmup_steps: length of the warm-up; 0 for none.
        warmup_factor: factor of the learning rate at its first step.
        adam_epsilon: epsilon of adam, adamw and radam.
        freeze: patterns of the names of parameters that do not learn.
    """

    name: OptimizerName = "adam"
    learning_rate: Positive = 1e-2
    final_learning_rate: Positive = 5e-4
    groups: dict[str, GroupConfig] = dataclasses.field(default_factory=_default_groups)
    warmup_steps: Natural = 20
    warmup_factor: Annotated[NotNegative, OnlyWith("warmup_steps")] = 0.01
    adam_epsilon: Positive = 1e-15
    freeze: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        self.groups = {
            pattern: group if isinstance(group, GroupConfig) else GroupConfig(**group)
            for pattern, group in self.groups.items()
        }

    def group(self, name: str) -> GroupConfig:
        """Return the settings of a group of `grouped`."""
        return self.groups.get(name, GroupConfig())

    def freeze_parameters(self, parameters: Mapping[str, nn.Parameter]) -> None:
        """Turn off the gradients of the parameters whose names match a pattern of `freeze`.

        Args:
            parameters: parameters by name.

        Raises:
            NerfroError: a pattern matches no parameter, or no parameter is left.
        """
        require_matches("optimizer.freeze", self.freeze, parameters)
        for name, parameter in parameters.items():
            if matches(name, self.freeze):
                parameter.requires_grad_(False)
        if self.freeze and not any(parameter.requires_grad for parameter in parameters.values()):
            raise NerfroError(f"optimizer.freeze={self.freeze} leaves no parameter to learn; remove a pattern")

    def optimizer_of(self, groups: Mapping[str, list[nn.Parameter]], fused: bool) -> torch.optim.Optimizer:
        """Create the optimizer of grouped parameters; several kinds become one `JointOptimizer`.

        Args:
            groups: result of `grouped`.
            fused: whether to fuse the operations of Adam.
        """
        described: list[dict[str, Any]] = []
        for name, parameters in groups.items():
            own = self.group(name)
            rate, start = own.learning_rate or self.learning_rate, own.start or 0
            described.append({
                "params": parameters, "lr": rate, "initial_lr": rate, "name": name, "start": start,
                "kind": own.name or self.name,
            })  # fmt: skip
        optimizers = {}
        for kind in dict.fromkeys(group["kind"] for group in described):
            options: dict[str, Any] = {} if kind in ("sgd", "muon") else {"eps": self.adam_epsilon}
            options |= {"fused": fused} if kind in ("adam", "adamw") else {}
            of_kind = [group for group in described if group["kind"] == kind]
            if kind not in _CLASSES:
                raise NerfroError(f"optimizer {kind} needs torch 2.9 or newer, and this is torch {torch.__version__}")
            if kind == "muon" and any(p.ndim != 2 for group in of_kind for p in group["params"]):
                raise NerfroError("optimizer muon takes matrices only; name it in optimizer.groups for fields.*.weight")
            optimizers[kind] = _CLASSES[kind](of_kind, **options)
        return next(iter(optimizers.values())) if len(optimizers) == 1 else JointOptimizer(optimizers, described)

    def grouped(self, parameters: Mapping[str, nn.Parameter]) -> dict[str, list[nn.Parameter]]:
        """Group the parameters that learn by the last pattern that matches; the others are in the group `COMMON`.

        Args:
            parameters: parameters by name.

        Raises:
            NerfroError: a pattern matches no parameter.
        """
        require_matches("optimizer.groups", self.groups, parameters)
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in parameters.items():
            if not parameter.requires_grad:
                continue
            matching = (pattern for pattern in reversed(self.groups) if matches(name, [pattern]))
            groups.setdefault(next(matching, COMMON), []).append(parameter)
        return groups


def matches(name: str, patterns: Iterable[str]) -> bool:
    """Return whether the name of a parameter matches a pattern, in which an asterisk stands for any text."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


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
        if pattern not in OPTIONAL_PATTERNS and not any(matches(name, [pattern]) for name in learned):
            raise NerfroError(
                f"{where}: {pattern} matches no learned parameter; choose from {', '.join(learned) or 'none'}, with * "
                "for any text"
            )
