"""Random training pixels."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt8
from omegaconf import DictConfig
from torch import Tensor

from nerfro.core.cameras import Window, central_window
from nerfro.core.distributed import share_of
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError, warn
from nerfro.core.transfer import transfer
from nerfro.core.types import Pixels
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.registry.allowed import Count, Natural, validated

Batching = Literal["single_image", "all_images"]


@validated("batches")
class PixelBatches:
    """Random training pixels of each step, which depend only on the seed and the step.

    Therefore a resumed run has the same pixels as an undisturbed run. Only usable pixels are drawn. The colours stay in
    main memory, and so do the pixels of a step, which `RayTracer.trace` sends to the training device together with
    their paths. See `training.config.BatchesConfig` for the options.

    Attributes:
        cameras: cameras of all views in the data set, on the training device.
    """

    def __init__(
        self,
        views: Views,
        batch_size: Count,
        batching: Batching = "all_images",
        seed: Natural = 0,
        precrop_steps: Natural = 0,
        precrop_fraction: float = 0.5,
        object_fraction: Annotated[float, Ge(0), Le(1)] = 0.0,
    ) -> None:
        if len(views) == 0:
            raise NerfroError("there are no training images; give at least one")
        self.batch_size, self.batching, self.seed = batch_size, batching, seed
        self.precrop_steps = precrop_steps
        self._share = slice(batch_size)
        self.cameras = self._host_cameras = cameras = views.cameras
        self._pixels = PixelStore(views.images)
        self._maps = {name: values.flatten(0, 2) for name, values in views.maps.items()}
        self._full = central_window(cameras.height, cameras.width, 1.0)
        self._crop = central_window(cameras.height, cameras.width, precrop_fraction if precrop_steps > 0 else 1.0)
        if batching == "single_image" and batch_size > self._crop.height * self._crop.width:
            raise NerfroError(
                f"batch_size={batch_size} exceeds the {self._crop.width}x{self._crop.height} pixels that one image"
                f"{' offers while precropped' if precrop_steps > 0 else ' has'}; take a smaller one, or all_images"
            )
        self._usable: dict[Window, _Usable] | None = None
        windows = {self._crop, self._full}
        if views.usable is not None:
            usable = views.usable
            self._usable = {window: _Usable((view == 1 for view in usable), len(views), window) for window in windows}
            self._check_usable(np.diff(self._usable[self._crop].starts), views.names)
        self._object_fraction = object_fraction
        self._of_object: dict[Window, _Usable] | None = None
        if object_fraction > 0 and views.masks is None:
            warn("batches.object_fraction: not every training photograph has a mask, so pixels are drawn of all alike")
        elif object_fraction > 0:
            self._of_object = {window: _of_object(views, batching, window) for window in windows}

    @classmethod
    def of(cls, views: Views, config: DictConfig) -> PixelBatches:
        """Make the pixels of a run from its configuration, see `TrainConfig`."""
        options = config.batches
        precrop, fraction = (options.precrop_steps, options.precrop_fraction), options.object_fraction
        return cls(views, options.size, options.batching, config.seed, *precrop, fraction)

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> PixelBatches:
        """Return the same sequence with cameras on another device and in another precision."""
        moved = copy.copy(self)
        moved._host_cameras, moved.cameras = self._host_cameras.to("cpu", dtype), self.cameras.to(device, dtype)
        return moved

    def release_memory(self) -> None:
        """Release the memory of mapped pixels, which are read again on demand."""
        self._pixels.release_memory()

    def for_rank(self, rank: int, size: int) -> PixelBatches:
        """Return the batches of process `rank` of `size` processes, each with an equal part of the pixels."""
        if self.batch_size % size:
            raise NerfroError(
                f"batches.size={self.batch_size} cannot be shared evenly by {size} processes; take a multiple of {size}"
            )
        shared = copy.copy(self)
        shared._share = share_of(self.batch_size, rank, size)
        return shared

    def smaller(self, most: int) -> PixelBatches:
        """Return the sequence with at most `most` pixels per step."""
        few = copy.copy(self)
        few.batch_size = min(most, self.batch_size)
        ends = (end * few.batch_size // self.batch_size for end in (self._share.start or 0, self._share.stop))
        few._share = slice(*ends)
        return few

    def draw(self, step: int) -> Pixels:
        """Draw the pixels of a step on the CPU, a function of seed and step."""
        cameras = self._host_cameras
        height, width = cameras.height, cameras.width
        window = self._full if step >= self.precrop_steps else self._crop
        view, pixel = self._draw(np.random.default_rng([self.seed, step]), window)
        row, column = window.top + pixel // window.width, window.left + pixel % window.width
        number = torch.from_numpy(((view * height + row) * width + column)[self._share])
        return Pixels(
            number=number,
            view=cameras.view_of(number),
            rgb=self._pixels[number],
            draws=Draws(self.seed, step, torch.arange(self.batch_size)[self._share]),
            cameras=cameras,
            window=cameras if window == self._full else cameras.crop(window),
            photographed=self.photographed,
            maps={name: values[number] for name, values in self._maps.items()},
        )

    @property
    def num_pixels(self) -> int:
        """Number of pixels of all views."""
        return len(self.cameras) * self.cameras.height * self.cameras.width

    def rows(self, part: int, num_parts: int) -> Int[Tensor, "Q"]:
        """Return the usable pixels of every `num_parts`-th row by number (view, row, column), equal in all processes.

        Rows are counted through all views. If masks exclude pixels, a row has the next usable pixels.
        """
        cameras = self.cameras
        width, window = cameras.width, self._full
        usable = None if self._usable is None else self._usable[window]
        total = self.num_pixels if usable is None else int(usable.starts[-1])
        first = np.arange(part * width, total, num_parts * width)
        numbers = (first[:, None] + np.arange(width)).ravel()
        numbers = numbers[numbers < total]
        if usable is not None:
            view, pixel = usable.find(numbers)
            numbers = view * window.height * window.width + pixel
        return transfer(torch.from_numpy(numbers), self.cameras.device)

    def of_each_view(self, num_pixels: int, step: int) -> Int[Tensor, "V Q"]:
        """Draw random usable pixels of every view; for a view without usable pixels, the first pixel is returned."""
        cameras = self.cameras
        generator = np.random.default_rng([self.seed, step, num_pixels, len(cameras)])
        size, shape = cameras.height * cameras.width, (len(cameras), num_pixels)
        if self._usable is None:
            within = generator.integers(size, size=shape)
        else:
            usable = self._usable[self._full]
            counts = np.diff(usable.starts)[:, None]
            drawn = generator.integers(np.maximum(counts, 1), size=shape) + usable.starts[:-1, None]
            _, within = usable.find(np.minimum(drawn, usable.starts[-1] - 1).ravel())
            within = np.where(counts > 0, within.reshape(shape), 0)
        numbers = within + size * np.arange(len(cameras))[:, None]
        return transfer(torch.from_numpy(numbers), cameras.device)

    def photographed(self, pixels: Int[Tensor, "Q"]) -> Float[Tensor, "Q 3"]:
        """Return the colours of pixels by number (view, row, column), sRGB as in `Views.images`."""
        return self._pixels[pixels.cpu()].to(pixels.device)

    def _draw(self, generator: np.random.Generator, window: Window) -> tuple[np.ndarray | np.int64, np.ndarray]:
        """Draw views, and pixels of the window by number (row, column)."""
        usable = None if self._usable is None else self._usable[window]
        num_pixels = window.height * window.width
        if self.batching == "single_image":
            view = generator.integers(len(self.cameras))
            first, end = (0, num_pixels) if usable is None else usable.starts[view : view + 2]
            # `choice` does not permute all pixels and is therefore fast.
            drawn = generator.choice(end - first, self.batch_size, replace=False, shuffle=False)
            return (view, drawn) if usable is None else usable.find(first + drawn)
        if usable is not None:
            views, pixels = usable.find(generator.integers(usable.starts[-1], size=self.batch_size))
        else:
            views = generator.integers(len(self.cameras), size=self.batch_size)
            pixels = generator.integers(num_pixels, size=self.batch_size)
        if self._of_object is not None:
            of_object, count = self._of_object[window], round(self._object_fraction * self.batch_size)
            # Evenly spaced in the batch, so that each process has the same number.
            rows = np.arange(count) * self.batch_size // max(1, count)
            views[rows], pixels[rows] = of_object.find(generator.integers(of_object.starts[-1], size=len(rows)))
        return views, pixels

    def _check_usable(self, counts: Int[np.ndarray, "V"], names: list[str]) -> None:
        """Raise an error if masks leave too few pixels for a batch."""
        precropped = " while precropped" if self.precrop_steps > 0 else ""
        fewest = int(counts.argmin())
        if self.batching == "single_image" and self.batch_size > counts[fewest]:
            raise NerfroError(
                f"batch_size={self.batch_size} exceeds the {counts[fewest]} pixels that the mask of {names[fewest]} "
                f"leaves{precropped}; take a smaller one, or all_images"
            )
        if counts.sum() == 0:
            raise NerfroError(f"the masks leave no pixel to train on{precropped}; black is ignored, white is used")


def _of_object(views: Views, batching: Batching, window: Window) -> _Usable:
    """Select the pixels that the object covers by more than half."""
    assert views.masks is not None
    if batching == "single_image":
        raise NerfroError("batches.object_fraction draws from all images at a time; take batches.batching=all_images")
    filled = (view > 0.5 for view in views.masks)
    if views.usable is not None:
        filled = (mask & (view == 1) for mask, view in zip(filled, views.usable, strict=True))
    pixels = _Usable(filled, len(views), window)
    if pixels.starts[-1] == 0:
        raise NerfroError(
            "batches.object_fraction draws pixels of the object, but the masks have none; correct them, or take 0"
        )
    return pixels


class _Usable:
    """Usable pixels of a window, numbered view by view and stored as bits.

    Args:
        usable: mask [H, W] of the usable pixels of each view.
        num_views: number of views.
        window: window of pixels.

    Attributes:
        starts: number of the first usable pixel of each view, and the total number.
    """

    _BLOCK = 64  # bits per stored count

    def __init__(self, usable: Iterable[Bool[Tensor, "H W"]], num_views: int, window: Window) -> None:
        num_blocks = -(-window.height * window.width // self._BLOCK)
        self._bits: UInt8[np.ndarray, "V blocks 8"] = np.empty((num_views, num_blocks, self._BLOCK // 8), np.uint8)
        counts = np.empty((num_views, num_blocks), np.int64)
        for index, view in enumerate(usable):
            blocks = np.zeros((num_blocks, self._BLOCK), bool)
            blocks.flat[: window.height * window.width] = window.cut(view[None]).flatten().cpu().numpy()
            self._bits[index], counts[index] = np.packbits(blocks, axis=-1), blocks.sum(-1)
        self._before = np.cumsum(counts) - counts.flatten()  # usable pixels before each block
        self.starts: Int[np.ndarray, "V+1"] = np.cumsum([0, *counts.sum(1)])

    def find(self, numbers: Int[np.ndarray, "Q"]) -> tuple[Int[np.ndarray, "Q"], Int[np.ndarray, "Q"]]:
        """Return the views, and the pixels of the window by number (row, column), of usable pixels."""
        block = np.searchsorted(self._before, numbers, side="right") - 1
        view, within = np.divmod(block, self._bits.shape[1])
        counted = np.unpackbits(self._bits[view, within], axis=-1).cumsum(-1, dtype=np.uint8)  # at most _BLOCK
        bit = (counted <= (numbers - self._before[block])[:, None]).sum(-1)
        return view, within * self._BLOCK + bit
