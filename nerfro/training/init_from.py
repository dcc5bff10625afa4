"""Initial values from the parameters of another run."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.optimizers.config import matches, require_matches
from nerfro.rendering import Renderer
from nerfro.training.load import checkpoint_of
from nerfro.training.run_folder import load_run, restore


def initialize_from(renderer: Renderer, run: str, include: Sequence[str]) -> str:
    """Copy parameters of another run with the same names and shapes, and the buffers of its fields and background.

    Args:
        renderer: model that receives the values.
        run: folder of the other run, or one of its checkpoints.
        include: patterns of names (`Scene.parameters_by_name`), in which an asterisk stands for any text.

    Returns:
        A line for each name that matches: loaded, skipped because the other run lacks it, or of another shape.

    Raises:
        NerfroError: the run cannot be read, a pattern matches no parameter, or nothing was loaded.
    """
    own, others = _values(renderer), _values(restore(*load_run(checkpoint_of(run))))
    require_matches("init_include", include, own)
    lines, num_loaded = [], 0
    for name, value in own.items():
        if not matches(name, include):
            continue
        other = others.get(name)
        if other is None:
            lines.append(f"  skipped {name}: {run} does not have it")
        elif other.shape != value.shape:
            lines.append(f"  skipped {name}: shape {list(value.shape)}, and {list(other.shape)} in {run}")
        else:
            with torch.no_grad():
                value.copy_(other)
            lines.append(f"  loaded {name}: shape {list(value.shape)}")
            num_loaded += 1
    if not num_loaded:
        raise NerfroError(
            f"init_from={run} has no parameter of init_include={list(include)} with the shape of this run"
        )
    return "\n".join([f"nerfro: {num_loaded} of {len(lines)} values from {run}", *lines])


def _values(renderer: Renderer) -> dict[str, Tensor]:
    """Return the parameters by name, and the stored buffers of fields and background."""
    parts = {"fields": renderer.scene.fields, "background": renderer.scene.background}
    stored = {
        f"{part}.{name}": value
        for part, module in parts.items()
        for name, value in module.state_dict(keep_vars=True).items()
    }
    return stored | renderer.parameters_by_name()
