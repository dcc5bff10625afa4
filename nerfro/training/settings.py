"""Roles of settings, which determine resuming, sweeps and tables."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from enum import Enum, auto
from typing import Any

from omegaconf import DictConfig, OmegaConf


class Role(Enum):
    """Role of a setting; METHOD for every setting outside `_NAMED`."""

    METHOD = auto()  # changes the trained model
    SEED = auto()  # random numbers
    SCENE = auto()  # data set
    BUDGET = auto()  # training time
    SCORING = auto()  # evaluation after the training
    MACHINE = auto()  # changes only time, memory and rounding
    OUTPUT = auto()  # names, logs, checkpoints and live view


_NAMED = {
    "seed": Role.SEED,
    "data.root": Role.SCENE,
    "trainer.max_steps": Role.BUDGET,
    "trainer.max_time": Role.BUDGET,
    "evaluation": Role.SCORING,
    "trainer.limit_test_batches": Role.SCORING,
    "evaluation.chunk_size": Role.MACHINE,
    "medium.cache": Role.MACHINE,
    "compile": Role.MACHINE,
    "trainer.accelerator": Role.MACHINE,
    "trainer.devices": Role.MACHINE,
    "trainer.num_nodes": Role.MACHINE,
    "trainer.strategy": Role.MACHINE,
    "name": Role.OUTPUT,
    "authors": Role.OUTPUT,  # used only by other settings
    "evaluation.every": Role.OUTPUT,
    "logger": Role.OUTPUT,
    "optimized_metric": Role.OUTPUT,
    "checkpoint": Role.OUTPUT,
    "ckpt_path": Role.OUTPUT,
    "viewer": Role.OUTPUT,
    "viewer_port": Role.OUTPUT,
    "trainer.log_every_n_steps": Role.OUTPUT,
    "trainer.enable_checkpointing": Role.OUTPUT,
    "trainer.enable_model_summary": Role.OUTPUT,
    "trainer.enable_progress_bar": Role.OUTPUT,
    "trainer.profiler": Role.OUTPUT,
}

# Settings with these roles must be equal to resume a checkpoint; budget, machine and scoring may differ.
RESUMING = frozenset({Role.METHOD, Role.SEED, Role.SCENE})
# Two runs of a sweep have the same result if all settings with these roles are equal.
RESULT = RESUMING | {Role.BUDGET, Role.SCORING}
# Runs with equal settings are one row of a table; scenes are columns, and each budget has a table.
TABLE_ROW = frozenset({Role.METHOD, Role.SCORING})


def role(name: str) -> Role:
    """Return the role of a setting by its full name, such as `trainer.max_steps`."""
    while name:
        if name in _NAMED:
            return _NAMED[name]
        name = name.rpartition(".")[0]
    return Role.METHOD


def settings(config: DictConfig | Mapping[str, Any], roles: frozenset[Role]) -> dict[str, Any]:
    """Return the settings of some roles by full name: `{"field": {"width": 64}}` becomes `{"field.width": 64}`."""
    return {name: value for name, value in flat(config, "").items() if role(name) in roles}


def with_values(config: DictConfig, values: Mapping[str, Any]) -> DictConfig:
    """Return a copy of a configuration with other values, by the full names of the settings."""
    changed = copy.deepcopy(config)
    for name, value in values.items():
        OmegaConf.update(changed, name, value, merge=False, force_add=True)
    return changed


def first_difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str | None:
    """Return the first name in alphabetical order with different values; None if all values are equal."""
    return next((name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)), None)


def flat(node: Any, prefix: str) -> dict[str, Any]:
    """Return all settings of a node by full name; `prefix` is the name of the node."""
    if isinstance(node, DictConfig):
        node = OmegaConf.to_container(node, resolve=True)
    if not isinstance(node, Mapping):
        return {prefix: node}
    children = (flat(child, f"{prefix}.{name}" if prefix else str(name)) for name, child in node.items())
    return {name: value for child in children for name, value in child.items()}
