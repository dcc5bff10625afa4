"""Checks of the rays before training, and of the parameters that training leaves unchanged."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import torch
from torch import nn

from nerfro.backgrounds.base import ConstantBackground
from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.rays import Rays
from nerfro.core.types import Batch
from nerfro.fields.base import Field
from nerfro.geometry.interpolation import intersect_box
from nerfro.rendering import RayTracer, Renderer
from nerfro.training.pixel_batches import PixelBatches

# Number of rays that are checked, and bounds of the number of their steps.
CHECKED_RAYS = 4096
_MIN_STEPS, _MAX_STEPS = 16, 1024


@torch.no_grad()
def require_reach(renderer: Renderer, batches: PixelBatches, tracer: RayTracer, first: Batch) -> None:
    """Refuse a field that no ray meets; warn if many rays miss the field and see a constant background.

    A small batch, or one photograph, may miss the field by chance, so batches are checked until a ray meets the field.

    Args:
        renderer: the model.
        batches: pixels of the training.
        tracer: traces their rays.
        first: batch of step 0.

    Raises:
        NerfroError: every ray misses the box of the field, ends before the object or begins behind it.
    """
    field = renderer.scene.fields[0]
    assert isinstance(field, Field)
    if (bounds := field.bounds) is None:
        _require_object(renderer, first.rays)
        return
    missed = 1.0
    num_steps = min(max(_MIN_STEPS, math.ceil(CHECKED_RAYS / batches.batch_size)), _MAX_STEPS)
    for step in range(num_steps):
        batch = first if step == 0 else tracer.trace(batches.draw(step))
        _require_object(renderer, batch.rays)
        path = renderer.trace(batch.rays, batch.path)
        enters, leaves = path.span(bounds.to(path.s))
        missed = float((enters >= leaves).double().mean())
        if missed < 1:
            break
    box = f"the field's box from {_rounded(bounds[0])} to {_rounded(bounds[1])}"
    advice = "set content.box_min and content.box_max around what the cameras see"
    if missed == 1:
        raise NerfroError(
            f"no ray of the training views meets {box}, and nothing is outside of it; check that unit, axes and place "
            f"of the object are those of the cameras, or {advice}"
        )
    if missed > 0.1 and isinstance(renderer.scene.background, ConstantBackground):
        warn(f"{missed:.0%} of the rays pass {box} and see background=constant alone, which learns nothing; {advice}")


def _require_object(renderer: Renderer, rays: Rays) -> None:
    """Refuse bounds of the rays without the object between them, for all rays towards its box."""
    box = renderer.scene.medium.content_box.to(rays.origins)
    enters, leaves = intersect_box(box, rays.origins, rays.directions)
    meets = (leaves > enters.clamp(min=0)) & bool((box[1] > box[0]).all())
    for name, bound, wrong, side in (
        ("near", rays.near, rays.near >= leaves, "behind"),
        ("far", rays.far, rays.far <= enters, "before"),
    ):
        if meets.any() and bool(wrong[meets].all()):
            raise NerfroError(
                f"data.{name}={bound.max():.4g} lies {side} the object, which the rays meet at distances from "
                f"{enters[meets].min():.4g} to {leaves[meets].max():.4g}; set data.near and data.far around these"
            )


def _rounded(corner: torch.Tensor) -> list[float]:
    return [float(f"{number:.3g}") for number in corner.tolist()]


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
