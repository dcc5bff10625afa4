"""The three stages of Eikonal Fields as one model."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Annotated, Any

import torch
from annotated_types import Ge
from jaxtyping import Bool, Float
from omegaconf import DictConfig
from torch import Tensor

from nerfro.core.compositing import composite
from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch, FieldValues, Path, Rays, Rendering, Samples
from nerfro.data.base import Views
from nerfro.fields.base import Field
from nerfro.geometry.space import Space, inside_box
from nerfro.registry.allowed import Count, Positive, Share
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer
from nerfro.samplers.base import straight_path

from .background import BackgroundGrids

Ask = Callable[[Samples], FieldValues]


class TrainingStage(IntEnum):
    """Stage of the training."""

    SCENE = 0
    INDEX = 1
    INTERIOR = 2


@register("model", "eikonal_fields")
class EikonalFields(Renderer):
    """Learn the scene along straight rays, then the index inside a box, then the radiance inside the box.

    1. Scene: a radiance field and the background, on straight rays.
    2. Index: the radiance inside the medium's box is dropped. The radiance outside is frozen on grids, which are blurry
       at first and sharpened level by level. The medium learns to bend the rays through the box.
    3. Interior: the paths are frozen as well, and a second radiance field learns the inside of the box.

    Each stage takes a fraction of the budget of the run, in steps or time, and the learning rates decay in each stage.

    Args:
        components: components of the model; the medium has parameters.
        scene_fraction, index_fraction: fractions of the budget for the first two stages; the third has the rest.
        resolution: vertices along each side of the grids of the second stage.
        blur: standard deviation of the blur at the first level, voxels; each level halves the value.
        num_levels: number of levels of blur, for equal fractions of the second stage.

    Attributes:
        stage: current `TrainingStage`; part of checkpoints.
        interior: radiance field of the third stage.

    Raises:
        NerfroError: the fractions leave a negative rest.
    """

    needs_box = True
    trains_in_parallel = False  # a stage leaves out parameters, whose gradients other processes would wait for

    stage: Tensor

    def __init__(
        self,
        components: Components,
        scene_fraction: Share = 0.4,
        index_fraction: Share = 0.4,
        resolution: Annotated[int, Ge(2)] = 128,
        blur: Positive = 2.0,
        num_levels: Count = 5,
    ) -> None:
        super().__init__(components, num_fields=1)
        if scene_fraction + index_fraction > 1:
            raise NerfroError(
                f"model=eikonal_fields: scene_fraction={scene_fraction} index_fraction={index_fraction}; "
                "take fractions that sum to at most 1; the interior has the rest"
            )
        self.interior = components.make_field()
        self.scene_fraction, self.index_fraction = scene_fraction, index_fraction
        self.resolution, self.blur, self.num_levels = resolution, blur, num_levels
        self.register_buffer("stage", torch.tensor(int(TrainingStage.SCENE)))
        self._sharp: BackgroundGrids | None = None
        self._blurred: BackgroundGrids | None = None
        self._level = -1

    def stage_at(self, progress: float) -> tuple[TrainingStage, float]:
        """Return the stage at a fraction of the budget, and the completed fraction of the stage."""
        if progress < self.scene_fraction:
            return TrainingStage.SCENE, progress / self.scene_fraction
        progress -= self.scene_fraction
        if progress < self.index_fraction:
            return TrainingStage.INDEX, progress / self.index_fraction
        rest = 1 - self.scene_fraction - self.index_fraction
        return TrainingStage.INTERIOR, min((progress - self.index_fraction) / rest, 1.0) if rest > 0 else 1.0

    def begin_step(self, progress: float) -> float:
        stage, done = self.stage_at(progress)
        self.stage.fill_(int(stage))
        if stage == TrainingStage.INDEX:
            self.sharpen(min(int(done * self.num_levels), self.num_levels - 1))
        else:
            self._sharp = self._blurred = None
        return done

    def sharpen(self, level: int) -> None:
        """Blur the surroundings of the box for a level of the second stage."""
        if self._sharp is None:
            scene = self.scene
            (field,) = scene.fields
            self._sharp = BackgroundGrids.fit(
                field,  # type: ignore[arg-type]
                scene.background,
                scene.space.box,
                scene.medium.box,
                self.resolution,
            )
        if self._blurred is None or level != self._level:
            self._level, self._blurred = level, self._sharp.blurred(self.blur / 2**level)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        views.refuse_linear_light("model=eikonal_fields")
        views.cameras.refuse_turntable("model=eikonal_fields also represents the room", "take another model")
        return {}

    def trace(self, rays: Rays, path: Path | None = None) -> Path:
        """Trace rays according to the current stage, because the medium changes during training."""
        stage = TrainingStage(int(self.stage))
        if stage == TrainingStage.SCENE:
            return straight_path(rays)
        with torch.set_grad_enabled(stage == TrainingStage.INDEX and torch.is_grad_enabled()):
            return self.path_sampler(rays, self.scene.medium)

    def render_path(self, path: Path, batch: Batch | None = None) -> list[Rendering]:
        stage = TrainingStage(int(self.stage))
        # Samples of the batch would lie on the path of the batch, which is not that of `trace`.
        samples = self.point_sampler(path, None, None if batch is None else batch.draws)
        (field,) = self.scene.fields
        if stage == TrainingStage.SCENE:
            return [composite(samples, field(samples), self.background(path, batch), path)]
        outside = ~inside_box(samples.positions.detach(), *self.scene.medium.box)
        if stage == TrainingStage.INDEX and self.training:
            assert self._blurred is not None  # made at the start of the step
            values = radiance_where(self._blurred.radiance_at, samples, outside)
            return [composite(samples, values, self._blurred.sky_towards(path.exit_directions), path)]
        with torch.no_grad():
            values = radiance_where(field, samples, outside)
            sky = self.background(path)
        if stage == TrainingStage.INTERIOR:
            inner = radiance_where(self.interior, samples, ~outside)
            values = FieldValues(values.density + inner.density, values.radiance + inner.radiance)
        return [composite(samples, values, sky, path)]


def radiance_where(field: Field | Ask, samples: Samples, selected: Bool[Tensor, "P N"]) -> FieldValues:
    """Evaluate a field only at the selected samples; density and radiance are zero elsewhere."""
    ray, i = selected.nonzero(as_tuple=True)
    queried = Samples(
        samples.positions[ray, i][:, None],
        samples.directions[ray, i][:, None],
        samples.s[ray, i][:, None],
        torch.stack([samples.edges[ray, i], samples.edges[ray, i + 1]], -1),
        samples.radii[ray],
    )
    values = field(queried)
    density: Float[Tensor, "P N"] = torch.zeros_like(samples.s)
    radiance: Float[Tensor, "P N 3"] = torch.zeros_like(samples.positions)
    return FieldValues(
        density.index_put((ray, i), values.density[:, 0].to(density)),
        radiance.index_put((ray, i), values.radiance[:, 0].to(radiance)),
    )
