"""Settings of the optimizer and of the learning rate, groups of parameters by name, and several optimizers as one."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any

import torch
from annotated_types import Ge, Lt
from torch import nn
from torch.optim import lr_scheduler

from nerfro.core.errors import NerfroError, nearest_of
from nerfro.registry.allowed import Names, Natural, NotNegative, OnlyWith, Positive, validated

# Patterns that have no effect in a scene without these parameters.
OPTIONAL_PATTERNS = (
    "background.*", "bodies.*.material.ior", "bodies.*.material.absorption", "cameras.*", "cameras.exposure",
)  # fmt: skip
# Name of the group of all parameters that no pattern matches.
COMMON = "common"

# Optimizers and schedulers by name, to which plugins add; see docs/guides/experiments_and_sweeps.md.
OPTIMIZERS: dict[str, type[torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "sgd": torch.optim.SGD, "radam": torch.optim.RAdam,
    **({"muon": torch.optim.Muon} if hasattr(torch.optim, "Muon") else {}),
}  # fmt: skip
SCHEDULERS: dict[str, type[lr_scheduler.LRScheduler]] = {
    scheduler.__name__: scheduler
    for scheduler in (
        lr_scheduler.CosineAnnealingLR, lr_scheduler.CosineAnnealingWarmRestarts, lr_scheduler.ExponentialLR,
        lr_scheduler.LinearLR, lr_scheduler.MultiStepLR, lr_scheduler.PolynomialLR, lr_scheduler.StepLR,
    )
}  # fmt: skip
# Tensors of the state, by the optimizer, without which no step is taken.
MOMENTS = dict.fromkeys(("adam", "adamw", "radam"), ("exp_avg", "exp_avg_sq")) | {"muon": ("momentum_buffer",)}
OptimizerName = Annotated[str, Names(lambda: OPTIMIZERS)]
SchedulerName = Annotated[str, Names(lambda: SCHEDULERS)]


@validated("optimizer.groups")
@dataclass
class GroupConfig:
    """Settings of all parameters whose names match a pattern.

    Attributes:
        learning_rate: initial learning rate; None for the common rate.
        start: step at which the parameters begin to learn; None for the step that the component of a run needs
            (`Component.learns_from`), which is 0 except for a background that a phase fits first.
        name: optimizer, to which plugins add; None for the common one.
        options: settings of the optimizer of this group, such as {momentum: 0.9}.
    """

    learning_rate: Positive | None = None
    start: Natural | None = None
    name: OptimizerName | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        _require_name("optimizer.groups: name", self.name, OPTIMIZERS)


def _default_groups() -> dict[str, GroupConfig]:
    return {"background.*": GroupConfig(learning_rate=2e-3)}


@validated("optimizer")
@dataclass
class OptimizerConfig:
    """Optimizer of PyTorch with a log-linear decay and a sine warm-up (authors' code; mip-NeRF, section 4).

    The defaults are those of the default experiment. The experiments `paper_*` have the values of the paper.

    Attributes:
        name: optimizer, to which plugins add.
        options: settings of this optimizer, such as {momentum: 0.9}; the others have PyTorch's defaults.
        scheduler: scheduler of PyTorch, in place of the decay and the warm-up; it takes a step after each training
            step.
        scheduler_options: settings of the scheduler, such as {T_max: 1000}.
        learning_rate: initial learning rate.
        final_learning_rate: learning rate at the end of the run.
        decay_start: fraction of the run after which the learning rate decays; 0 as in the authors' code.
        groups: learning rate and start of parameters by the pattern of their names
            (`Scene.parameters_by_name`), in which an asterisk stands for any text: {bodies.*.material.ior:
            {learning_rate: 1e-3, start: 100}}. The rates have the same decay. Of several matching patterns the
            last one decides.
        warmup_steps: length of the warm-up; 0 for none.
        warmup_factor: factor of the learning rate at its first step.
        adam_epsilon: epsilon of adam, adamw and radam.
        adam_beta: decay of the mean of squared gradients of adam, adamw and radam (beta 2).
        freeze: patterns of the names of parameters that do not learn.
    """

    name: OptimizerName = "adam"
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    scheduler: SchedulerName | None = None
    scheduler_options: Annotated[dict[str, Any], OnlyWith("scheduler")] = dataclasses.field(default_factory=dict)
    learning_rate: Positive = 1e-2
    final_learning_rate: Positive = 2e-4
    decay_start: Annotated[float, Ge(0), Lt(1)] = 0.5
    groups: dict[str, GroupConfig] = dataclasses.field(default_factory=_default_groups)
    warmup_steps: Natural = 20
    warmup_factor: Annotated[NotNegative, OnlyWith("warmup_steps")] = 0.01
    adam_epsilon: Positive = 1e-15
    adam_beta: Annotated[float, Ge(0), Lt(1)] = 0.999
    freeze: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        _require_name("optimizer.name", self.name, OPTIMIZERS)
        _require_name("optimizer.scheduler", self.scheduler, SCHEDULERS)
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

        Raises:
            NerfroError: an optimizer does not have an option, or refuses its value or its parameters.
        """
        described: list[dict[str, Any]] = []
        optimizers: dict[str, torch.optim.Optimizer] = {}
        for kind, options, of_kind in self._by_kind(groups):
            if kind == "muon" and any(p.ndim != 2 for group in of_kind for p in group["params"]):
                raise NerfroError("optimizer muon takes matrices only; name it in optimizer.groups for fields.*.weight")
            adam = {"eps": self.adam_epsilon, "betas": (0.9, self.adam_beta)}
            options = (adam if kind in ("adam", "adamw", "radam") else {}) | options
            if kind in ("adam", "adamw") and not {"foreach", "differentiable"} & options.keys():
                options = {"fused": fused} | options
            optimizers[of_kind[0]["kind"]] = _created(f"optimizer {kind}", OPTIMIZERS[kind], of_kind, options)
            described += of_kind
        if len(optimizers) == 1:
            return next(iter(optimizers.values()))
        return JointOptimizer(optimizers, described)

    def _by_kind(self, groups: Mapping[str, list[nn.Parameter]]) -> list[tuple[str, dict, list[dict[str, Any]]]]:
        """Describe groups for an optimizer, by the name and the options of their optimizer."""
        kinds: dict[str, tuple[str, dict, list[dict[str, Any]]]] = {}
        for name, parameters in groups.items():
            own = self.group(name)
            rate, kind = own.learning_rate or self.learning_rate, own.name or self.name
            options = (self.options if kind == self.name else {}) | own.options
            group = {"params": parameters, "lr": rate, "initial_lr": rate, "name": name, "start": own.start or 0}
            key = f"{kind} {options}" if options else kind
            kinds.setdefault(key, (kind, options, []))[-1].append({**group, "kind": key})
        return list(kinds.values())

    def scheduler_of(self, optimizer: torch.optim.Optimizer) -> lr_scheduler.LRScheduler | None:
        """Create the scheduler of an optimizer; None without `scheduler`.

        Raises:
            NerfroError: the scheduler does not have an option, or refuses its value.
        """
        if self.scheduler is None:
            return None
        where = f"optimizer.scheduler={self.scheduler}"
        return _created(where, SCHEDULERS[self.scheduler], optimizer, self.scheduler_options)

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


def _require_name(where: str, name: str | None, names: Mapping[str, Any]) -> None:
    if name is not None and name not in names:
        raise NerfroError(f"{where}={name} is not allowed; {nearest_of(name, list(names))}")


def _created(where: str, cls: Callable[..., Any], of: object, options: Mapping[str, Any]) -> Any:
    """Create an optimizer of groups of parameters, or a scheduler of an optimizer."""
    _, *parameters = inspect.signature(cls).parameters.values()
    allowed = [parameter.name for parameter in parameters if parameter.name != "lr"]
    takes_any = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters)
    unknown = next((name for name in options if name == "lr" or not (takes_any or name in allowed)), None)
    if unknown is not None:
        advice = "set learning_rate" if unknown == "lr" else f"choose from {', '.join(allowed)}"
        raise NerfroError(f"{where} has no option {unknown}; {advice}")
    try:
        return cls(of, **options)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise NerfroError(f"{where}: {error}; see the documentation of {cls.__name__} for its options") from error


class JointOptimizer(torch.optim.Optimizer):
    """Several optimizers of PyTorch as one, each of which steps its own groups.

    Args:
        optimizers: optimizers by kind.
        groups: groups of all optimizers, whose `kind` names their optimizer.
    """

    def __init__(self, optimizers: Mapping[str, torch.optim.Optimizer], groups: list[dict[str, Any]]) -> None:
        self._optimizers = dict(optimizers)
        super().__init__(groups, {})
        self._share_state()

    def __setstate__(self, state: dict[str, Any]) -> None:  # also called by `load_state_dict`
        super().__setstate__(state)
        self._share_state()

    def _share_state(self) -> None:
        for kind, optimizer in self._optimizers.items():
            optimizer.state = self.state
            optimizer.param_groups = [group for group in self.param_groups if group["kind"] == kind]

    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for optimizer in self._optimizers.values():
            optimizer.step(None if closure is None else lambda: loss)  # type: ignore[arg-type, return-value]
        return loss
