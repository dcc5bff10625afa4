"""What can be shown of a scene: the whole of it, its parts alone, and what is known beside colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.viewing.trained_scene import RenderedViews, TrainedScene

Pictures = Float[Tensor, "V H W C"]


@dataclass(frozen=True)
class Layer:
    """One thing that is shown."""

    # Of which scene, where some of its parts are taken away.
    glass: bool
    inside: bool
    values: Callable[[RenderedViews], Pictures]  # as they are: linear radiance, world units, unit vectors
    # The values as sRGB in [0, 1]; depth is drawn between the bounds of the camera's rays.
    shown: Callable[[RenderedViews, Cameras], Pictures]

    def of(self, scene: TrainedScene) -> TrainedScene:
        """The scene of which it is rendered."""
        return scene if self.glass and self.inside else scene.with_(glass=self.glass, inside=self.inside)


def _grey(values: Float[Tensor, "V H W"]) -> Pictures:
    return values[..., None].clamp(0, 1).expand(*values.shape, 3)


def _near_is_bright(rendered: RenderedViews, cameras: Cameras) -> Pictures:
    share = (cameras.far - rendered.depth) / (cameras.far - cameras.near)
    return _grey(torch.where(rendered.opacity < 0.5, 0.0, share))


def _vectors(values: Pictures) -> Pictures:
    """Unit vectors as colours: (x, y, z) from -1 to 1 are red, green and blue from 0 to 1; none is black."""
    return torch.where((values == 0).all(-1, keepdim=True), 0.0, 0.5 + 0.5 * values).clamp(0, 1)


def _colours(glass: bool = True, inside: bool = True) -> Layer:
    return Layer(glass, inside, lambda rendered: rendered.radiance, lambda rendered, _: rendered.rgb)


LAYERS = {
    "rgb": _colours(),
    "depth": Layer(True, True, lambda rendered: rendered.depth[..., None], _near_is_bright),
    "normals": Layer(True, True, lambda r: r.normals, lambda r, _: _vectors(r.normals)),
    "opacity": Layer(True, True, lambda r: r.opacity[..., None], lambda r, _: _grey(r.opacity)),
    "exits": Layer(True, True, lambda r: r.exit_directions, lambda r, _: _vectors(r.exit_directions)),
    "glass": _colours(inside=False),
    "inside": _colours(glass=False),
    "sky": _colours(glass=False, inside=False),
}
