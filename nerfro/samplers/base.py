"""What path samplers and point samplers are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from nerfro.fields.base import Field
from nerfro.media.base import Medium
from nerfro.samplers.branching import ONE_PATH
from nerfro.types import Path, Rays, Rendering, Samples


class PathSampler(nn.Module, ABC):
    """Bends rays into paths: traced without gradients, and refined where something learns from them."""

    needs_medium = True  # whether it asks the medium at all; if not, none is built
    replays_surface = False  # whether `refine` has gradients by a surface that learns
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
    """Chooses arc lengths on a path; random in training (by `Path.rand`), the same every time in evaluation.

    `Samples.along` asks the path for positions and directions there.
    """

    num_levels: int  # how often the path is sampled, each level guided by the rendering of the one before

    @abstractmethod
    def forward(self, path: Path, previous: Rendering | None) -> Samples:
        """Sample the path, first without and then with the previous level's rendering."""

    def after_step(self, step: int, fields: Sequence[Field]) -> None:
        """Learn from the radiance fields after a training step, if the sampler remembers anything of them."""
