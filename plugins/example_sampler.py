"""Template: a point sampler of your own in one file. Use it with `sampler/points=logarithmic`.

Copy this file, rename the class and the registered name, and change `forward`.
"""

from __future__ import annotations

import torch

from nerfro.parts import Count, Draws, Path, PointSampler, Rendering, Samples, point_samples, register

_GROWTH = 4.0  # ratio of the last spacing to the first


@register("sampler/points", "logarithmic")
class LogarithmicSampler(PointSampler):
    """Draw samples with a spacing that grows with the distance, as the footprint of a pixel does.

    Args:
        num_samples: number of samples on each path.
    """

    num_levels = 1

    def __init__(self, num_samples: Count = 64) -> None:
        super().__init__()
        self.num_samples = num_samples

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        bins = torch.arange(self.num_samples, device=path.s.device, dtype=path.s.dtype).expand(len(path.s), -1)
        # Random in training, central in evaluation: the contract of every sampler.
        offsets = 0.5 if draws is None else draws.for_rays(path.ray, self.num_samples)
        u = (bins + offsets) / self.num_samples
        fraction = (_GROWTH**u - 1) / (_GROWTH - 1)
        return point_samples(path, path.near[:, None] + fraction * (path.far - path.near)[:, None])
