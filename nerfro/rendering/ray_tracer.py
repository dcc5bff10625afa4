"""Rays through pixels of training views: cameras, subdivision, paths, and samples that are chosen ahead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.rays import Rays
from nerfro.core.transfer import transfer
from nerfro.core.types import Batch, Path, Pixels
from nerfro.rendering.host_renderer import HostRenderer
from nerfro.rendering.renderer import Renderer
from nerfro.samplers.subdivision import (
    DIVERGENT,
    NEIGHBOUR,
    Subdivision,
    contrast,
    divergence,
    main_exits,
    part_rays,
    pixel_rays,
)

# Maps rays of the cameras of the data set, given their views, to rays of the estimated cameras.
Estimate = Callable[[Rays, Int[Tensor, "R"]], Rays]


@dataclass(frozen=True)
class PixelRays:
    """Rays through pixels, one or several for each; rays of undivided pixels come first.

    Attributes:
        rays: R rays.
        path: path of each ray.
        ray_pixel: pixel of each ray, as an index of the given pixels.
        part: number of the ray within the pixel.
        diverges: pixels whose neighbouring rays diverge by at least `DIVERGENT` pixel angles; none if no pixel may be
            divided.
    """

    rays: Rays
    path: Path
    ray_pixel: Int[Tensor, "R"]
    part: Int[Tensor, "R"]
    diverges: Bool[Tensor, "Q"]


class RayTracer:
    """Trace rays through pixels, several through pixels that one ray does not represent.

    Args:
        renderer: the model, with cameras, medium and samplers.
        subdivision: criteria for the division of pixels. Straight rays do not diverge, so samplers that need no medium
            have one ray for each pixel.
    """

    def __init__(self, renderer: Renderer, subdivision: Subdivision | None = None) -> None:
        self._renderer = renderer
        bends = renderer.path_sampler.needs_medium
        self.subdivision = subdivision if subdivision is not None and bends else Subdivision()
        self._host: HostRenderer | None = None

    def trace(self, pixels: Pixels) -> Batch:
        """Trace the rays of the estimated cameras through the pixels of a step, and choose samples if they are known.

        Compiled kernels run on the CPU, and the batch is sent to the device of the model in one copy. The rays have
        gradients if the cameras learn. The paths have none, see `Renderer.trace`.

        Args:
            pixels: pixels of a step, on the CPU.
        """
        tracer = self
        if self._renderer.traces_on_cpu and self._renderer.scene.device.type != "cpu":
            self._host = self._host or HostRenderer(self._renderer)
            tracer = RayTracer(self._host.updated(), self.subdivision)
        return transfer(tracer._trace(pixels), self._renderer.scene.device)

    def _trace(self, pixels: Pixels) -> Batch:
        """Trace the rays of pixels on the device of the model."""
        pixels = transfer(pixels, self._renderer.scene.device)
        contrasts = None
        if self.subdivision.contrast is not None and pixels.draws.step >= self.subdivision.contrast_start:
            contrasts = lambda rows: contrast(pixels.photographed, pixels.cameras, pixels.number[rows])  # noqa: E731
        traced = self.through(pixels.cameras, pixels.number, contrasts, self._renderer.scene.camera)
        index = pixels.draws.ray[traced.ray_pixel] * self.subdivision.side**2 + traced.part
        draws = replace(pixels.draws, ray=index)
        return Batch(
            rays=traced.rays,
            ray_pixel=traced.ray_pixel,
            pixel_number=pixels.number,
            view=pixels.view,
            rgb=pixels.rgb,
            teaches_background=~traced.diverges,
            cameras=pixels.window,
            draws=draws,
            path=traced.path,
            samples=self._renderer.point_sampler.choose_ahead(traced.path, draws),
            maps=pixels.maps,
        )

    def through(
        self,
        cameras: Cameras,
        pixels: Int[Tensor, "Q"],
        contrasts: Callable[[Int[Tensor, " subset"]], Float[Tensor, " subset"]] | None = None,
        estimate: Estimate = lambda rays, view: rays,
    ) -> PixelRays:
        """Trace rays through pixels.

        Args:
            cameras: cameras of all views.
            pixels: numbers of the pixels.
            contrasts: contrast of the pixels in given rows of `pixels`; None disables the criterion.
            estimate: camera model; by default, the cameras are exact.
        """
        rows, num_parts = torch.arange(len(pixels), device=pixels.device), self.subdivision.side**2
        view = cameras.view_of(pixels)
        if num_parts == 1:
            rays, none = estimate(pixel_rays(cameras, pixels), view), torch.zeros_like(rows)
            return PixelRays(rays, self._paths(rays), rows, none, none.bool())
        # The centre of each pixel, and then the neighbouring ray of each pixel.
        position = cameras.fx.new_tensor([0.5, NEIGHBOUR]).repeat_interleave(len(pixels))
        both = estimate(pixel_rays(cameras, pixels.repeat(2), position[:, None].expand(-1, 2)), view.repeat(2))
        rays, path = both[: len(pixels)], self._paths(both[: len(pixels)])
        angle = divergence(cameras, pixels, main_exits(path), self._renderer.exit_directions(both[len(pixels) :]))
        divided = angle >= self.subdivision.divergence
        if contrasts is not None and self.subdivision.contrast is not None:
            bent = (path.main_polyline(path.refracted) & ~divided).nonzero()[:, 0]
            divided = divided.index_put((bent,), contrasts(bent) >= self.subdivision.contrast)
        whole, parted = (~divided).nonzero()[:, 0], divided.nonzero()[:, 0]
        pixel = parted.repeat_interleave(num_parts)
        parts = estimate(part_rays(cameras, pixels[parted], self.subdivision.side), view[pixel])
        part = torch.arange(num_parts, device=pixels.device).repeat(len(parted))
        return PixelRays(
            rays=Rays.joined([rays[whole], parts]),
            path=Path.joined([path.select_rays(whole), self._paths(parts)]),
            ray_pixel=torch.cat([whole, pixel]),
            part=torch.cat([torch.zeros_like(whole), part]),
            diverges=angle >= DIVERGENT,
        )

    @torch.no_grad()
    def _paths(self, rays: Rays) -> Path:
        return self._renderer.path_sampler(rays, self._renderer.scene.medium)
