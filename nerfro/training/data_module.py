"""Training and validation data as Lightning asks for them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar, cast

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from omegaconf import DictConfig
from torch import Tensor

from nerfro.data.base import Views
from nerfro.rendering import Renderer
from nerfro.subdivision import Subdivision
from nerfro.training.module import TrainingModule
from nerfro.training.ray_batches import RayBatches
from nerfro.training.watched import WatchedPixels
from nerfro.types import Batch

# Looks at pixels for one at a picture: two tell less of a curve than ten, and cost a few steps each.
_LOOKS_PER_PICTURE = 5
# A look without a picture, where the number of a validation view would be.
NO_PICTURE = -1


class RayDataModule(LightningDataModule):
    """Random training pixels and one validation view at a time.

    The pixels move to the training device when training begins. All that needs training pixels later takes them from
    `batches`, so that there is one copy.

    Every fifth look at the validation views (`looks_every`) is a picture of one of them; some of their pixels are
    looked at each time.

    Lightning fetches data a step early. It is given the numbers of the steps, and each step's batch when it begins: so
    paths that bend in a medium that learns bend in it as it is then.
    """

    def __init__(self, batches: RayBatches, validation: Views | None, every: int) -> None:
        super().__init__()
        self.batches, self.validation, self.every = batches, validation, every
        self.watched = None if validation is None else WatchedPixels.of(validation)
        self._ahead: OneAhead | None = None

    def train_dataloader(self) -> Iterator[int]:
        assert self.trainer is not None  # Lightning attaches it before it asks
        device, module = self.trainer.strategy.root_device, cast(TrainingModule, self.trainer.lightning_module)
        self.batches = self.batches.to(device, cast(torch.dtype, module.dtype))
        self.end_thread()
        if device.type == "cpu" and can_trace_ahead(module.renderer):
            self._ahead = OneAhead(self.batches.batch)
        # Lightning asks after it has restored a checkpoint, so a resumed run goes on with the batch it would have had.
        return itertools.count(self.trainer.global_step)

    def val_dataloader(self) -> RotatingView | list[int]:
        return [] if self.validation is None else RotatingView(self)

    def watched_psnr(self) -> Float[Tensor, ""]:
        """Of pixels of validation views, with the rays that training gives such pixels as the medium is now; dB."""
        assert self.trainer is not None
        assert self.watched is not None
        return self.watched.psnr(cast(TrainingModule, self.trainer.lightning_module).renderer, self.batches.subdivision)

    def transfer_batch_to_device(self, batch: int, device: torch.device, dataloader_idx: int) -> Batch | int:
        assert self.trainer is not None
        if not self.trainer.training:
            return batch  # the number of a validation view, or none
        if self._ahead is not None:
            return self._ahead(batch)
        with torch.no_grad():
            return self.batches.batch(batch)

    def teardown(self, stage: str) -> None:
        self.end_thread()
        self.batches.forget()

    def on_exception(self, exception: BaseException) -> None:
        self.end_thread()

    def make_anew(self) -> None:
        """What bends rays is about to move: forget the batch that was made ahead."""
        if self._ahead is not None:
            self._ahead.forget()

    def end_thread(self) -> None:
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None


Made = TypeVar("Made")


class OneAhead(Generic[Made]):
    """Has a thread make what is asked for next, on a core that waits. It makes the same as it would when it is asked.

    The thread keeps to one core, and kernels leave Python and Numba's threads to others (`kernels.compilation`).
    """

    def __init__(self, make: Callable[[int], Made]) -> None:
        self._make = make
        self._next: tuple[int, Future[Made]] | None = None
        # PyTorch counts threads for each thread on its own, and gives the last count to those that begin.
        threads = torch.get_num_threads()
        self._thread = ThreadPoolExecutor(1, "paths", lambda: torch.set_num_threads(1))
        self._thread.submit(torch.get_num_threads).result()
        torch.set_num_threads(threads)

    def __call__(self, step: int) -> Made:
        """The batch of a step; whatever goes wrong in the thread is raised here."""
        if self._next is None or self._next[0] != step:
            self._next = (step, self._thread.submit(self._without_gradients, step))
        batch = self._next[1].result()
        self._next = (step + 1, self._thread.submit(self._without_gradients, step + 1))
        return batch

    def forget(self) -> None:
        """Wait for what is being made, and have it made again when it is asked for."""
        if self._next is not None:
            self._next[1].exception()
            self._next = None

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(cancel_futures=True)

    def _without_gradients(self, step: int) -> Made:
        with torch.no_grad():
            return self._make(step)


def can_trace_ahead(renderer: Renderer) -> bool:
    """Whether a thread can trace the next step's rays meanwhile: nothing that bends them learns, and a core is free."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with torch.enable_grad():
        return cores > 1 and not renderer.paths_learn and renderer.path_sampler.releases_gil(renderer.scene.medium)


def traced(batches: RayBatches, renderer: Renderer, config: DictConfig) -> RayBatches:
    """The batches with their paths, and with several rays in pixels for which one does not stand."""
    subdivision = Subdivision(**config.batches.subdivision)
    return batches.traced(
        lambda rays, view: renderer.path_sampler(renderer.scene.camera(rays, view), renderer.scene.medium),
        lambda rays, view: renderer.exit_directions(renderer.scene.camera(rays, view)),
        subdivision if renderer.path_sampler.needs_medium else None,  # straight rays do not diverge
    )


def looks_every(every: int) -> int:
    """Steps between two looks at validation pixels, where so many are between two pictures; 0 for never."""
    return 0 if every == 0 else max(1, every // _LOOKS_PER_PICTURE)


class RotatingView:
    """One validation view each time that a picture is due, the next one at the next time; else `NO_PICTURE`."""

    def __init__(self, module: RayDataModule) -> None:
        self._module = module

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[int]:
        module = self._module
        assert module.trainer is not None
        picture, since = divmod(module.trainer.global_step, max(module.every, 1))
        due = since < looks_every(module.every)
        yield picture % len(module.validation or [0]) if due else NO_PICTURE
