"""Check of the rays before training."""

from __future__ import annotations

import math

import torch

from nerfro.backgrounds.constant import ConstantBackground
from nerfro.core.errors import NerfroError, warn
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
