"""What path samplers and point samplers are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from nerfro.draws import Draws
from nerfro.fields.base import Field
from nerfro.media.base import Medium
from nerfro.samplers.branching import ONE_PATH
from nerfro.types import Path, Rays, Rendering, Samples


class PathSampler(nn.Module, ABC):
    """Bends rays into paths: traced without gradients, and refined where something learns from them."""

    needs_medium = True  # whether it asks the medium at all; if not, none is built
    branching = ONE_PATH  # which parts of light that is partly reflected are followed

    @abstractmethod
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace every ray from near to far through the medium; a bent path ends outside it, if need be beyond far."""

    def main(self, rays: Rays, medium: Medium) -> Path:
        """The first polyline of every ray, as `forward` traces it: for what asks only where rays go."""
        return self(rays, medium)

    def refine(self, path: Path, rays: Rays, medium: Medium) -> Path:
        """The traced path with gradients by what bends it, and the same values; asked where something of that learns.

        Silhouettes that move, and events that appear or go, have no gradients.
        """
        return path

    def steady(self, path: Path, medium: Medium) -> Bool[Tensor, "P"]:
        """Which traced paths have derivatives that are bounded; those of others are left out in training."""
        return torch.ones_like(path.refracted)

    def releases_python(self, medium: Medium) -> bool:
        """Whether a thread that traces on the CPU leaves Python to others, so that it can work beside them."""
        return False


class PointSampler(nn.Module, ABC):
    """Chooses arc lengths on a path.

    Attributes:
        num_levels: number of times that the path is sampled, each level guided by the rendering of the level before.
    """

    num_levels: int

    @abstractmethod
    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        """Sample a path.

        Args:
            path: P polylines in arc length.
            previous: rendering of the level before; None at the first level.
            draws: random numbers of the training step; None in evaluation, where samples are deterministic. All
                randomness comes from `draws.for_rays(path.ray, num)`, so that all polylines of a ray share their
                numbers, and so that a run that resumes repeats the steps of an undisturbed run.

        Returns:
            Samples in ascending arc length; `Samples.along` looks up positions and directions on the path.
        """

    def after_step(self, fields: Sequence[Field], draws: Draws) -> None:
        """Update what the sampler remembers of the radiance fields.

        Args:
            fields: radiance field of each sampling level, as `draws.step` training steps have made them.
            draws: random numbers of the step that follows.
        """
