"""Camera rays. Shapes use the axis letters of `nerfro.core.types`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Camera rays in world space.

    Attributes:
        origins: camera centres.
        directions: unit viewing directions.
        radii: radius of the pixel's cone at unit distance (mip-NeRF, section 3.1).
        near, far: arc length from the origin at the start and end of the path; a bent path never ends in the object.
    """

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    radii: Float[Tensor, "R"]
    near: Float[Tensor, "R"]
    far: Float[Tensor, "R"]

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return Rays(self.origins[index], self.directions[index], self.radii[index], self.near[index], self.far[index])

    @classmethod
    def joined(cls, parts: Sequence[Rays]) -> Rays:
        """Concatenate rays."""
        return cls(*map(torch.cat, zip(*[vars(part).values() for part in parts], strict=True)))

    def to(self, where_or_what: torch.device | str | torch.dtype) -> Rays:
        """Move the rays to a device, or convert to a precision."""
        return Rays(*(tensor.to(where_or_what) for tensor in vars(self).values()))

    def detach(self) -> Rays:
        """Detach the rays from the graph of gradients."""
        return Rays(*(tensor.detach() for tensor in vars(self).values()))
