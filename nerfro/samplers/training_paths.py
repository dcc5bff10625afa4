"""All paths that training asks for, known before it starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from nerfro.cameras import Cameras
from nerfro.media.base import Medium
from nerfro.pixel_parts import PixelParts
from nerfro.samplers.base import PathSampler
from nerfro.samplers.divergence import divergent_pixels
from nerfro.samplers.path_cache import PathCache
from nerfro.types import Batch, Path


@dataclass(frozen=True)
class TrainingPaths:
    """Paths through the pixels of training images; where one ray does not stand for a pixel, through parts of it.

    Attributes:
        whole: paths through the centres of all pixels.
        parts: rays of the divided pixels; None where there are none.
        divided: their paths.
    """

    whole: PathCache
    parts: PixelParts | None = None
    divided: PathCache | None = None

    @classmethod
    def build(
        cls, path_sampler: PathSampler, medium: Medium, cameras: Cameras, side: int = 1, divergence: float = 8.0
    ) -> TrainingPaths:
        """Trace all rays, or read their paths from the cache.

        Args:
            path_sampler, medium: how rays bend.
            cameras: of the training images.
            side: rays in each direction of a divided pixel; 1 divides none.
            divergence: pixels are divided whose exit direction differs from a neighbour's by this many pixel angles.
        """
        whole = PathCache.build(path_sampler, medium, PixelParts(cameras))
        pixels = divergent_pixels(whole, cameras, divergence) if side > 1 else None
        if pixels is None or len(pixels) == 0:
            return cls(whole)
        parts = PixelParts(cameras, side, pixels)
        return cls(whole, parts, PathCache.build(path_sampler, medium, parts))

    def __call__(self, batch: Batch) -> Path:
        """Paths of a batch's rays."""
        if self.divided is None or batch.num_whole is None:
            return self.whole(batch.index, batch.rays)
        whole, divided = slice(batch.num_whole), slice(batch.num_whole, None)
        path = self.whole(batch.index[whole], batch.rays[whole])
        return path.followed_by(self.divided(batch.index[divided], batch.rays[divided]))


def trace_training_rays(config: DictConfig, model: Any, cameras: Cameras) -> TrainingPaths | None:
    """Paths of all training rays, if they stay the same and are short enough to be kept."""
    wanted = config.batches
    if not wanted.cache_paths or wanted.jitter or not model.path_sampler.few_vertices:
        return None
    return TrainingPaths.build(model.path_sampler, model.medium, cameras, wanted.supersample, wanted.divergence)
