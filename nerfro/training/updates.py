"""Parameters that should learn, and that a run leaves unchanged."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import nn

from nerfro.core.errors import first_of, warn


class Updates:
    """Compare the parameters of a run with their values at its start, and warn of those without an update.

    Args:
        parameters: parameters that gradient descent learns, by name.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter]) -> None:
        self._parameters = {name: own for name, own in parameters.items() if own.requires_grad}
        self._before = {name: _sums(parameter) for name, parameter in self._parameters.items()}
        self._warned: set[str] = set()

    def unchanged(self) -> list[str]:
        """Return the names of the parameters with the same values as at the start, without those of a warning."""
        names = (name for name, parameter in self._parameters.items() if _sums(parameter) == self._before[name])
        return [name for name in names if name not in self._warned]

    def warn_of_late_starts(self, max_steps: int, starts: Mapping[nn.Parameter, int]) -> None:
        """Warn, after the phases before training, of parameters that begin to learn only after the last step.

        Args:
            max_steps: number of steps of the run; -1 if unknown.
            starts: first step of each parameter.
        """
        first = {name: starts[self._parameters[name]] for name in self.unchanged()}
        late = [name for name, start in first.items() if 0 <= max_steps <= start]
        steps = ", ".join(str(start) for start in sorted({first[name] for name in late}))
        self._warn(late, f"because optimizer.groups starts at step {steps}, and trainer.max_steps={max_steps}")

    def warn_of_unchanged(self) -> None:
        """Warn, at the end of a run, of all parameters that the run has not changed."""
        reason = "because their gradient was zero or missing, or optimizer.groups starts them later"
        self._warn(self.unchanged(), f"{reason}; start from other values, or turn them off by optimizer.freeze")

    def _warn(self, names: Collection[str], reason: str) -> None:
        if names:
            self._warned |= {*names}
            warn(f"{first_of(list(names))} keep{'s' * (len(names) == 1)} the initial values in this run, {reason}")


@torch.no_grad()
def _sums(parameter: nn.Parameter) -> tuple[float, float]:
    """Return two numbers that any step of an optimizer changes."""
    values = parameter.detach()
    return float(values.sum(dtype=torch.float64)), float(torch.linalg.vector_norm(values, dtype=torch.float64))
