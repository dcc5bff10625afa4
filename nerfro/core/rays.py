"""Camera rays. Shapes use the axis letters of `nerfro.core.types`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

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
        room: rotation from the world to the room in which the background stands still, see `Cameras.turntable`; None
            if the background turns with the world.
    """

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    radii: Float[Tensor, "R"]
    near: Float[Tensor, "R"]
    far: Float[Tensor, "R"]
    room: Float[Tensor, "R 3 3"] | None = None

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return self._each(lambda tensor: tensor[index])

    @classmethod
    def joined(cls, parts: Sequence[Rays]) -> Rays:
        """Concatenate rays."""
        columns = zip(*[vars(part).values() for part in parts], strict=True)
        joined: list[Any] = [None if column[0] is None else torch.cat(column) for column in columns]
        return cls(*joined)

    def to(self, where_or_what: torch.device | str | torch.dtype) -> Rays:
        """Move the rays to a device, or convert to a precision."""
        return self._each(lambda tensor: tensor.to(where_or_what))

    def detach(self) -> Rays:
        """Detach the rays from the graph of gradients."""
        return self._each(Tensor.detach)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Rays:
        changed: list[Any] = [None if tensor is None else change(tensor) for tensor in vars(self).values()]
        return Rays(*changed)


def in_room(directions: Float[Tensor, "P 3"], room: Float[Tensor, "P 3 3"] | None) -> Float[Tensor, "P 3"]:
    """Rotate directions of the world to the room, see `Rays.room`."""
    return directions if room is None else (room * directions[:, None]).sum(-1)  # a product would lose precision
