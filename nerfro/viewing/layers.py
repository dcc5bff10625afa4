"""Layers of a rendering: colours of the scene or of some components, depth, normals, opacity and exit directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.core.cameras import Cameras
from nerfro.viewing.trained_scene import RenderedViews, TrainedScene

Images = Float[Tensor, "V H W C"]


@dataclass(frozen=True)
class Layer:
    """A quantity that is rendered.

    Attributes:
        glass, inside: whether the rendered scene contains the glass, and the content of the glass.
        normals: whether the content shows its normals.
        values: values in their units: linear radiance, world units or unit vectors.
        shown: values as sRGB in [0, 1]; depth is scaled to the bounds of the camera's rays.
    """

    glass: bool
    inside: bool
    values: Callable[[RenderedViews], Images]
    shown: Callable[[RenderedViews, Cameras], Images]
    normals: bool = False

    def of(self, scene: TrainedScene) -> TrainedScene:
        """Return the scene with the components of this layer."""
        return scene.with_(glass=self.glass, inside=self.inside, normals=self.normals)


def _grey(values: Float[Tensor, "V H W"]) -> Images:
    return values[..., None].clamp(0, 1).expand(*values.shape, 3)


def _depth_image(rendered: RenderedViews, cameras: Cameras) -> Images:
    """Map depth to grey: near is bright, and pixels of low opacity are black."""
    fraction = (cameras.far - rendered.depth) / (cameras.far - cameras.near)
    return _grey(torch.where(rendered.opacity < 0.5, 0.0, fraction))


def _vector_image(values: Images) -> Images:
    """Map x, y and z of unit vectors from [-1, 1] to red, green and blue in [0, 1]; zero vectors are black."""
    return torch.where((values == 0).all(-1, keepdim=True), 0.0, 0.5 + 0.5 * values).clamp(0, 1)


def _content_normals(rendered: RenderedViews) -> Images:
    """Return the composited normals as unit vectors; zero in pixels of low opacity."""
    return torch.where(rendered.opacity[..., None] < 0.5, 0.0, normalize(rendered.radiance, dim=-1))


def _colours(glass: bool = True, inside: bool = True) -> Layer:
    return Layer(glass, inside, lambda rendered: rendered.radiance, lambda rendered, _: rendered.rgb)


LAYERS = {
    "rgb": _colours(),
    "depth": Layer(True, True, lambda rendered: rendered.depth[..., None], _depth_image),
    "normals": Layer(True, True, lambda r: r.normals, lambda r, _: _vector_image(r.normals)),
    "content_normals": Layer(
        True, True, _content_normals, lambda r, _: _vector_image(_content_normals(r)), normals=True
    ),
    "opacity": Layer(True, True, lambda r: r.opacity[..., None], lambda r, _: _grey(r.opacity)),
    "exits": Layer(True, True, lambda r: r.exit_directions, lambda r, _: _vector_image(r.exit_directions)),
    "glass": _colours(inside=False),
    "inside": _colours(glass=False),
    "sky": _colours(glass=False, inside=False),
}
