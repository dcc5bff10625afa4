"""The method's three stages as one model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.fields.selection import inside_box
from nerfro.registry import register
from nerfro.rendering import Components, Renderer, composite
from nerfro.samplers.straight import straight_path
from nerfro.types import Path, Radiance, Rays, Rendering, Samples

from .background import Background

Ask = Callable[[Samples], Radiance]


class Stage(IntEnum):
    """What is being learned."""

    SCENE = 0
    INDEX = 1
    INTERIOR = 2


@register("model", "eikonal_fields")
class EikonalFields(Renderer):
    """Eikonal Fields: the scene along straight rays, then the index in a box, then what is inside it.

    1. Scene: a radiance field and the boundary, on straight rays.
    2. Index: what the first stage found inside the medium's box is dropped and what lies around it is frozen, as grids
       that are blurred first and sharpened level by level. The medium learns to bend the rays that cross the box.
    3. Interior: paths are frozen too, and a second radiance field learns what is inside the box.

    A stage ends with its share of the run's budget, in steps or time, and the learning rates decay anew in each.

    Attributes:
        stage: see `Stage`; part of checkpoints.
        interior: radiance field of the third stage.
    """

    trains_in_parallel = False  # a stage leaves out parameters, whose gradients other processes would wait for

    stage: Tensor
    box: Float[Tensor, "2 3"]

    def __init__(
        self,
        components: Components,
        scene_share: float = 0.4,
        index_share: float = 0.4,
        box_min: Sequence[float] = (-1.0, -1.0, -1.0),
        box_max: Sequence[float] = (1.0, 1.0, 1.0),
        resolution: int = 128,
        blur: float = 2.0,
        num_levels: int = 5,
    ) -> None:
        """Compose the model.

        Args:
            components: that it is composed of; its medium has parameters.
            scene_share, index_share: of the budget for the first two stages; the third has the rest.
            box_min, box_max: corners of the box in which radiance is sampled, world units.
            resolution: vertices a side of the grids of the second stage.
            blur: standard deviation of the first level's blur, voxels; halved at each level.
            num_levels: of blur, for equal shares of the second stage.

        Raises:
            NerfroError: a number is out of range.
        """
        super().__init__(components, num_fields=1)
        if not (scene_share > 0 and index_share > 0 and scene_share + index_share <= 1):
            raise NerfroError(
                f"model=eikonal_fields: scene_share={scene_share} index_share={index_share}; "
                "take two positive shares that leave the rest of 1 to the interior"
            )
        if resolution < 2 or blur <= 0 or num_levels < 1:
            raise NerfroError(
                f"model=eikonal_fields: resolution={resolution} blur={blur} num_levels={num_levels}; "
                "take at least 2 vertices, a positive blur and 1 level or more"
            )
        self.interior = components.make_field()
        self.scene_share, self.index_share = scene_share, index_share
        self.resolution, self.blur, self.num_levels = resolution, blur, num_levels
        self.register_buffer("box", torch.tensor([list(box_min), list(box_max)]), persistent=False)
        self.register_buffer("stage", torch.tensor(int(Stage.SCENE)))
        self._sharp: Background | None = None
        self._blurred: Background | None = None
        self._level = -1

    def stage_at(self, progress: float) -> tuple[Stage, float]:
        """The stage at a share of the budget, and the share of that stage that is done."""
        if progress < self.scene_share:
            return Stage.SCENE, progress / self.scene_share
        progress -= self.scene_share
        if progress < self.index_share:
            return Stage.INDEX, progress / self.index_share
        rest = 1 - self.scene_share - self.index_share
        return Stage.INTERIOR, min((progress - self.index_share) / rest, 1.0) if rest > 0 else 1.0

    def begin_step(self, progress: float) -> float:
        stage, done = self.stage_at(progress)
        self.stage.fill_(int(stage))
        if stage == Stage.INDEX:
            self.sharpen(min(int(done * self.num_levels), self.num_levels - 1))
        else:
            self._sharp = self._blurred = None
        return done

    def sharpen(self, level: int) -> None:
        """Blur what is seen around the box as it is at a level of the second stage."""
        if self._sharp is None:
            scene = self.scene
            (field,) = scene.fields
            self._sharp = Background.fit(
                field,  # type: ignore[arg-type]
                scene.boundary,
                self.box,
                scene.medium.box,
                self.resolution,
            )
        if self._blurred is None or level != self._level:
            self._level, self._blurred = level, self._sharp.blurred(self.blur / 2**level)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        # Parameters outside of a stage get no gradient, which Adam skips.
        return {**super().parameter_groups(), "interior": list(self.interior.parameters())}

    def trace(self, rays: Rays, path: Path | None = None) -> Path:
        """Paths of rays as the present stage sees them, traced anew: what bends them is learned, or was."""
        stage = Stage(int(self.stage))
        if stage == Stage.SCENE:
            return straight_path(rays)
        with torch.set_grad_enabled(stage == Stage.INDEX and torch.is_grad_enabled()):
            return self.path_sampler(rays, self.scene.medium)

    def render_path(
        self, path: Path, draws: Draws | None = None, teaches_background: Bool[Tensor, "R"] | None = None
    ) -> list[Rendering]:
        stage = Stage(int(self.stage))
        samples = self.point_sampler(path, None, draws)
        (field,) = self.scene.fields
        if stage == Stage.SCENE:
            return [composite(samples, field(samples), self.background(path, teaches_background), path)]
        outside = ~inside_box(samples.positions.detach(), *self.scene.medium.box)
        if stage == Stage.INDEX and self.training:
            assert self._blurred is not None  # made at the start of the step
            radiance = radiance_where(self._blurred.radiance_at, samples, outside)
            return [composite(samples, radiance, self._blurred.sky_towards(path.exit_directions), path)]
        with torch.no_grad():
            radiance = radiance_where(field, samples, outside)
            sky = self.background(path)
        if stage == Stage.INTERIOR:
            inner = radiance_where(self.interior, samples, ~outside)
            radiance = Radiance(radiance.density + inner.density, radiance.rgb + inner.rgb)
        return [composite(samples, radiance, sky, path)]


def radiance_where(field: Field | Ask, samples: Samples, selected: Bool[Tensor, "R N"]) -> Radiance:
    """Ask a field at the selected samples alone; elsewhere density and colour are zero."""
    ray, i = selected.nonzero(as_tuple=True)
    chosen = Samples(
        samples.positions[ray, i][:, None],
        samples.directions[ray, i][:, None],
        samples.s[ray, i][:, None],
        torch.stack([samples.edges[ray, i], samples.edges[ray, i + 1]], -1),
        samples.radii[ray],
    )
    found = field(chosen)
    density: Float[Tensor, "R N"] = torch.zeros_like(samples.s)
    rgb: Float[Tensor, "R N 3"] = torch.zeros_like(samples.positions)
    return Radiance(
        density.index_put((ray, i), found.density[:, 0].to(density)),
        rgb.index_put((ray, i), found.rgb[:, 0].to(rgb)),
    )
