"""Which settings make a run what it is: the one statement that resuming, sweeps and tables go by."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

from omegaconf import DictConfig, OmegaConf


class Role(Enum):
    """What a setting says about a run; whatever `_NAMED` does not name says what is learned, and how."""

    METHOD = "what is learned, and how"
    SEED = "which random draws"
    SCENE = "on which data"
    BUDGET = "for how long"
    SCORING = "how it is rendered and scored in the end"
    MACHINE = "where: changes time, memory and rounding"
    WATCHING = "how it is called, followed and stored"


_NAMED = {
    "seed": Role.SEED,
    "data.root": Role.SCENE,
    "trainer.max_steps": Role.BUDGET,
    "trainer.max_time": Role.BUDGET,
    "evaluation": Role.SCORING,
    "evaluation.chunk_size": Role.MACHINE,
    "evaluation.lpips_backbone": Role.MACHINE,
    "evaluation.lpips_vgg_backbone": Role.MACHINE,
    "medium.cache": Role.MACHINE,
    "compile": Role.MACHINE,
    "trainer.accelerator": Role.MACHINE,
    "trainer.devices": Role.MACHINE,
    "trainer.num_nodes": Role.MACHINE,
    "trainer.strategy": Role.MACHINE,
    "name": Role.WATCHING,
    "authors": Role.WATCHING,  # only what other settings are taken from
    "evaluation.every": Role.WATCHING,
    "logger": Role.WATCHING,
    "checkpoint": Role.WATCHING,
    "ckpt_path": Role.WATCHING,
    "viewer": Role.WATCHING,
    "viewer_port": Role.WATCHING,
    "trainer.log_every_n_steps": Role.WATCHING,
    "trainer.enable_model_summary": Role.WATCHING,
}

# A checkpoint can be gone on from where these agree: for longer, on another machine, scored in another way.
RESUMING = frozenset({Role.METHOD, Role.SEED, Role.SCENE})
# Two cells of a sweep in which these agree have the same result.
RESULT = RESUMING | {Role.BUDGET, Role.SCORING}
# Runs in which these agree are one row of a table; scenes are columns, budgets have tables of their own.
TABLE_ROW = frozenset({Role.METHOD, Role.SCORING})


def role(name: str) -> Role:
    """What a setting says about a run, by its full name such as `trainer.max_steps`."""
    while name:
        if name in _NAMED:
            return _NAMED[name]
        name = name.rpartition(".")[0]
    return Role.METHOD


def settings(config: DictConfig | Mapping[str, Any], roles: frozenset[Role]) -> dict[str, Any]:
    """The settings of some roles, by their full names: `{"field": {"width": 64}}` becomes `{"field.width": 64}`."""
    if isinstance(config, DictConfig):
        config = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    return {name: value for name, value in _flat(config, "").items() if role(name) in roles}


def first_difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str | None:
    """The first name, in alphabetical order, that has different values; None if there is none."""
    return next((name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)), None)


def _flat(node: Any, prefix: str) -> dict[str, Any]:
    if not isinstance(node, Mapping):
        return {prefix: node}
    children = (_flat(child, f"{prefix}.{name}" if prefix else str(name)) for name, child in node.items())
    return {name: value for child in children for name, value in child.items()}
