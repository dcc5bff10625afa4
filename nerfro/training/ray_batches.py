"""Random training pixels, resident on the training device."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from nerfro.cameras import Cameras, Window, central_window
from nerfro.data.base import Views
from nerfro.data.pictures import Pictures
from nerfro.distributed import share_of
from nerfro.errors import NerfroError
from nerfro.pixel_parts import PixelParts
from nerfro.training.pixel_store import PixelStore
from nerfro.types import Batch

Batching = Literal["single_image", "all_images"]


class RayBatches:
    """An endless sequence of random training pixels, in which batch `i` depends on the seed and `i` alone.

    A run that stops and resumes with `first_step` set therefore sees the batches that it would have seen.

    Args:
        views: posed images, of which the usable pixels are drawn; their tensors' device is where batches are made, see
            `to`.
        batch_size: number of pixels in a batch.
        batching: `single_image` draws different pixels of one random image, `all_images` draws each pixel anew from
            all images.
        seed: of the sequence.
        precrop_steps: number of steps at first during which pixels come from the middle of the images.
        precrop_fraction: share of each side that this middle spans.
        jitter: send rays through a random place in each pixel instead of through its centre.
        first_step: step at which iteration begins.

    Raises:
        NerfroError: an option is out of range, or an image (or its middle) has fewer usable pixels than a batch.
    """

    def __init__(
        self,
        views: Views,
        batch_size: int,
        batching: Batching = "single_image",
        seed: int = 0,
        precrop_steps: int = 0,
        precrop_fraction: float = 0.5,
        jitter: bool = False,
        first_step: int = 0,
    ) -> None:
        if batching not in get_args(Batching):
            raise NerfroError(f"batching={batching!r} is unknown; choose {' or '.join(map(repr, get_args(Batching)))}")
        for name, value, least in (
            ("batch_size", batch_size, 1),
            ("seed", seed, 0),
            ("precrop_steps", precrop_steps, 0),
            ("first_step", first_step, 0),
        ):
            if value < least:
                raise NerfroError(f"{name}={value} is too small; take {least} or more")
        if len(views) == 0:
            raise NerfroError("there are no training images; give at least one")
        self.batch_size, self.batching, self.seed = batch_size, batching, seed
        self.precrop_steps, self.jitter, self.first_step = precrop_steps, jitter, first_step
        self._share = slice(batch_size)
        self._parts: PixelParts | None = None
        self._place: Int[np.ndarray, "V*H*W"] = np.empty(0, np.int32)  # of each pixel among the divided ones, or -1
        cameras = views.cameras
        self._cameras = cameras
        self._pixels = PixelStore(views.images)
        self._crop = central_window(cameras.height, cameras.width, precrop_fraction if precrop_steps > 0 else 1.0)
        if batching == "single_image" and batch_size > self._crop.height * self._crop.width:
            raise NerfroError(
                f"batch_size={batch_size} exceeds the {self._crop.width}x{self._crop.height} pixels that one image"
                f"{' offers while precropped' if precrop_steps > 0 else ' has'}; take a smaller one, or all_images"
            )
        self._usable: dict[Window, _Usable] | None = None
        if views.usable is not None:
            windows = {self._crop, central_window(cameras.height, cameras.width, 1.0)}
            self._usable = {window: _Usable(views.usable, window) for window in windows}
            self._check_usable(np.diff(self._usable[self._crop].starts), views.names)

    def to(self, device: torch.device | str) -> RayBatches:
        """The same sequence with cameras and pixels on another device."""
        moved = copy.copy(self)
        moved._cameras, moved._pixels = self._cameras.to(device), self._pixels.to(device)
        moved._parts = None if self._parts is None else self._parts.to(device)
        return moved

    def dividing(self, parts: PixelParts) -> RayBatches:
        """The sequence with all rays of `parts` where it has one of the pixels that they divide."""
        assert parts.pixels is not None
        divided = copy.copy(self)
        divided._parts = parts
        divided._place = np.full(len(self._cameras) * self._cameras.height * self._cameras.width, -1, np.int32)
        divided._place[parts.pixels.cpu().numpy()] = np.arange(len(parts.pixels))
        return divided

    def forget(self) -> None:
        """Give back the memory of mapped pixels, which are read again when they are asked for."""
        self._pixels.forget()

    def share(self, rank: int, size: int) -> RayBatches:
        """The sequence of process `rank` of `size`: an equal part of every batch, in its order.

        Raises:
            NerfroError: the batch has no equal parts.
        """
        if self.batch_size % size:
            raise NerfroError(
                f"batches.size={self.batch_size} cannot be shared evenly by {size} processes; take a multiple of {size}"
            )
        shared = copy.copy(self)
        shared._share = share_of(self.batch_size, rank, size)
        return shared

    def __iter__(self) -> Iterator[Batch]:
        step = self.first_step
        while True:
            yield self.batch(step)
            step += 1

    def batch(self, step: int) -> Batch:
        """The batch (or the share) of a step: a function of seed and step alone, on every device the same pixels."""
        cameras = self._cameras
        height, width = cameras.height, cameras.width
        window = central_window(height, width, 1.0) if step >= self.precrop_steps else self._crop
        generator = np.random.default_rng([self.seed, step])
        view, pixel = self._draw(generator, window)
        row, column = window.top + pixel // window.width, window.left + pixel % window.width
        drawn = (view * height + row) * width + column
        if self._parts is not None:
            return self._divided_batch(drawn, cameras.crop(window))
        drawn = drawn[self._share]
        # One small copy to the device; the rest is computed there.
        index = torch.from_numpy(drawn).to(cameras.device, non_blocking=True)
        jitter = None
        if self.jitter:
            offsets = generator.random((self.batch_size, 2), dtype=np.float32)
            jitter = torch.from_numpy(offsets[self._share]).to(cameras.device, non_blocking=True)
        return Batch(
            rays=cameras.rays(index // (height * width), index // width % height, index % width, jitter),
            view=index // (height * width),
            rgb=self._pixels[index],
            index=index,
            cameras=cameras.crop(window),
        )

    def _divided_batch(self, drawn: Int[np.ndarray, "P"], cameras: Cameras) -> Batch:
        """The batch of the drawn pixels: first those that have one ray, then the divided ones with all of theirs."""
        assert self._parts is not None
        several = self._parts.rays_per_pixel
        is_divided = self._place[drawn] >= 0
        # Each pixel's first row in the whole batch.
        num_rays = np.where(is_divided, several, 1)
        order = np.argsort(is_divided, kind="stable")
        first_row = np.empty(len(drawn), np.int64)
        first_row[order] = np.cumsum(num_rays[order]) - num_rays[order]

        pixel, row, divided = drawn[self._share], first_row[self._share], is_divided[self._share]
        first_part = several * self._place[pixel[divided]].astype(np.int64)

        def for_each_ray(of_whole: np.ndarray, of_divided: np.ndarray, step: int) -> np.ndarray:
            return np.concatenate([of_whole, (of_divided[:, None] + step * np.arange(several)).ravel()])

        of_each_ray = (
            for_each_ray(pixel[~divided], pixel[divided], 0),
            for_each_ray(pixel[~divided], first_part, 1),
            for_each_ray(row[~divided], row[divided], 1),
        )
        # One small copy to the device; the rest is computed there.
        pixels, index, rows = torch.from_numpy(np.stack(of_each_ray)).to(self._cameras.device, non_blocking=True)
        num_whole = int((~divided).sum())
        return Batch(
            rays=PixelParts(self._cameras).rays(index[:num_whole]).followed_by(self._parts.rays(index[num_whole:])),
            view=pixels // (self._cameras.height * self._cameras.width),
            rgb=self._pixels[pixels],
            index=index,
            cameras=cameras,
            num_whole=num_whole,
            rays_per_pixel=several,
            rows=rows,
            num_rows=int(num_rays.sum()),
        )

    def _draw(self, generator: np.random.Generator, window: Window) -> tuple[np.ndarray | np.int64, np.ndarray]:
        """Views and pixels of the window, numbered row by row."""
        usable = None if self._usable is None else self._usable[window]
        num_pixels = window.height * window.width
        if self.batching == "single_image":
            view = generator.integers(len(self._cameras))
            first, end = (0, num_pixels) if usable is None else usable.starts[view : view + 2]
            # Floyd's algorithm or a partial shuffle inside: far cheaper than a permutation of all pixels.
            drawn = generator.choice(end - first, self.batch_size, replace=False, shuffle=False)
            return (view, drawn) if usable is None else usable.find(first + drawn)
        if usable is not None:
            return usable.find(generator.integers(usable.starts[-1], size=self.batch_size))
        views = generator.integers(len(self._cameras), size=self.batch_size)
        return views, generator.integers(num_pixels, size=self.batch_size)

    def _check_usable(self, counts: Int[np.ndarray, "V"], names: list[str]) -> None:
        """Refuse masks that leave too few pixels to draw a batch from."""
        precropped = " while precropped" if self.precrop_steps > 0 else ""
        fewest = int(counts.argmin())
        if self.batching == "single_image" and self.batch_size > counts[fewest]:
            raise NerfroError(
                f"batch_size={self.batch_size} exceeds the {counts[fewest]} pixels that the mask of {names[fewest]} "
                f"leaves{precropped}; take a smaller one, or all_images"
            )
        if counts.sum() == 0:
            raise NerfroError(f"the masks leave no pixel to train on{precropped}; black is ignored, white is used")


class _Usable:
    """The pixels of a window that may be drawn, numbered one view's after another's, kept as bits.

    Args:
        usable: 1 in the pixels [H, W] that may be drawn, of each view.
        window: of pixels.

    Attributes:
        starts: numbers at which those of each view begin, and the end.
    """

    _BLOCK = 64  # bits that are counted together

    def __init__(self, usable: Pictures | Bool[Tensor, "V H W"], window: Window) -> None:
        num_blocks = -(-window.height * window.width // self._BLOCK)
        self._bits: UInt8[np.ndarray, "V B 8"] = np.empty((len(usable), num_blocks, self._BLOCK // 8), np.uint8)
        counts = np.empty((len(usable), num_blocks), np.int64)
        for index, view in enumerate(usable):
            blocks = np.zeros((num_blocks, self._BLOCK), bool)
            blocks.flat[: window.height * window.width] = window.cut(view[None] == 1).flatten().cpu().numpy()
            self._bits[index], counts[index] = np.packbits(blocks, axis=-1), blocks.sum(-1)
        self._before = np.cumsum(counts) - counts.flatten()  # usable pixels before each block
        self.starts: Int[np.ndarray, "V+1"] = np.cumsum([0, *counts.sum(1)])

    def find(self, numbers: Int[np.ndarray, "P"]) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
        """View and pixel, row by row of the window, of usable pixels by their numbers."""
        block = np.searchsorted(self._before, numbers, side="right") - 1
        view, within = np.divmod(block, self._bits.shape[1])
        counted = np.unpackbits(self._bits[view, within], axis=-1).cumsum(-1, dtype=np.int64)
        place = (counted <= (numbers - self._before[block])[:, None]).sum(-1)
        return view, within * self._BLOCK + place
