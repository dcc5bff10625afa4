"""Several optimizers of PyTorch as one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch


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
