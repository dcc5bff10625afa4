"""Validation during training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.camera.base import fit_gain
from nerfro.core.cameras import Cameras
from nerfro.core.types import mean_per_pixel
from nerfro.data.base import Views
from nerfro.rendering import RayTracer, Renderer
from nerfro.rendering.ray_tracer import PixelRays
from nerfro.samplers.subdivision import Subdivision, contrast

# Number of validation pixels, and largest number of their views.
_NUM_PIXELS, _MAX_VIEWS = 2048, 32


@dataclass(frozen=True)
class ValidationPixels:
    """Pixels of validation views, the same ones in each validation so that scores can be compared.

    Attributes:
        cameras: cameras of the validation views.
        index: numbers of the pixels, view * H * W + row * W + column.
        rgb: colours in the photographs, sRGB as in `Views.images`.
        contrasts: contrast to the neighbouring pixels, see `subdivision.contrast`.
    """

    cameras: Cameras
    index: Int[Tensor, "Q"]
    rgb: Float[Tensor, "Q 3"]
    contrasts: Float[Tensor, "Q"]

    @classmethod
    def of(cls, views: Views, seed: int = 0) -> ValidationPixels:
        """Draw random usable pixels, the same number from each view."""
        generator = np.random.default_rng([seed, 0])
        spread = views.spread(_MAX_VIEWS)
        size, indices, colours, contrasts = views.cameras.height * views.cameras.width, [], [], []
        for view in spread:
            allowed = np.arange(size)
            if views.usable is not None:
                usable = torch.as_tensor(views.usable[view]).flatten().numpy() == 1
                allowed = np.flatnonzero(usable) if usable.any() else allowed
            drawn = torch.from_numpy(generator.choice(allowed, min(_NUM_PIXELS // len(spread), len(allowed)), False))
            indices.append(view * size + drawn)
            image = views.images[view].reshape(-1, 3)
            colours.append(image[drawn])
            contrasts.append(contrast(image.__getitem__, views.cameras, drawn))
        return cls(views.cameras, *map(torch.cat, (indices, colours, contrasts)))

    def rays(self, renderer: Renderer, subdivision: Subdivision | None) -> PixelRays:
        """Return rays through the pixels, subdivided as in training."""
        device = renderer.scene.device
        tracer, contrasts = RayTracer(renderer, subdivision), self.contrasts.to(device)
        return tracer.through(self.cameras.to(device), self.index.to(device), lambda rows: contrasts[rows])

    def psnr(self, renderer: Renderer, subdivision: Subdivision | None) -> Float[Tensor, ""]:
        """Compute the PSNR of the rendered pixels in dB; learned exposures are replaced by fitted gains of each view.

        Args:
            renderer: model.
            subdivision: which pixels get several rays; None for no pixel.
        """
        device = renderer.scene.device
        traced, rgb = self.rays(renderer, subdivision), self.rgb.to(device)
        radiance = mean_per_pixel(renderer.radiance(traced.rays), traced.ray_pixel, len(rgb))
        if renderer.scene.camera.exposure is None:
            return _psnr(renderer.scene.colour_space.to_display(radiance), rgb)
        views = self.cameras.view_of(self.index.to(device))
        gains, colour_space = torch.ones_like(radiance), renderer.scene.colour_space
        for view in views.unique():
            gains[views == view] = fit_gain(colour_space.to_srgb, radiance[views == view], rgb[views == view])
        return _psnr(colour_space.to_display(radiance, gains), rgb)


def _psnr(prediction: Float[Tensor, "Q 3"], target: Float[Tensor, "Q 3"]) -> Float[Tensor, ""]:
    return -10 * torch.log10((prediction - target.clamp(0, 1)).square().mean())
