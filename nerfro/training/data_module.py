"""Training and validation data for Lightning."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any, Generic, TypeVar, cast

import torch
from lightning.pytorch import LightningDataModule, Trainer
from torch import nn

from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch
from nerfro.data.base import Views
from nerfro.evaluation.validation import ValidationPixels
from nerfro.kernels.threads import end_helpers, start_helpers
from nerfro.rendering import RayTracer, Renderer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.module import TrainingModule
from nerfro.training.pixel_batches import PixelBatches

# Weights of linear layers; the default field has 9,000, the networks of the paper 1.2 million.
_LARGE = 100_000


class RayDataModule(LightningDataModule):
    """Random training pixels and one validation view at a time.

    All components take training pixels from `batches`.

    Each validation (`validation_interval`) evaluates the validation pixels, and every fifth one also renders a view.

    Lightning fetches data one step early. Therefore the loader yields the numbers of steps, and the batch is made when
    its step begins, or one step ahead if no learned parameter bends paths. The rays of a
    batch are traced before the phases of its step: after a step of `phase=cameras`, one batch has paths of the previous
    cameras.

    Args:
        batches: pixels of each step.
        validation: validation views; None for no validation.
        every: number of steps between two validation images; 0 for never.
        overfit_batches: number of batches that are repeated; 0 for new batches in all steps.
        subdivision: criteria for several rays through a pixel; None for one ray.
        load_test: reads the views of `trainer.test` and `trainer.predict`; None for no such views.

    Attributes:
        tracer: traces the rays of the batches, once training begins.
    """

    tracer: RayTracer

    def __init__(
        self,
        batches: PixelBatches,
        validation: Views | None = None,
        every: int = 0,
        overfit_batches: int = 0,
        subdivision: Subdivision | None = None,
        load_test: Callable[[], Views] | None = None,
    ) -> None:
        super().__init__()
        self._load_test = load_test
        self._overfit_batches, self.subdivision = overfit_batches, subdivision
        self.batches, self.validation, self.every = batches, validation, every
        self.validation_pixels = None if validation is None else ValidationPixels.of(validation)
        self._ahead: Prefetcher | None = None

    def train_dataloader(self) -> Iterable[int]:
        assert self.trainer is not None  # attached by Lightning
        device, module = self.trainer.strategy.root_device, cast(TrainingModule, self.trainer.lightning_module)
        self.batches = self.batches_of(self.trainer).to(device, cast(torch.dtype, module.dtype))
        self.tracer = RayTracer(module.renderer, self.subdivision)
        self.end_thread()
        if can_prefetch(module.renderer):
            self._ahead = Prefetcher(self._batch, shares_steps=not multiplies_large_matrices(module.renderer))
        # Lightning calls this method after restoring a checkpoint, so a resumed run continues with the next batch.
        trainer: Any = self.trainer
        if trainer.check_val_every_n_epoch is not None and isinstance(trainer.val_check_interval, float):
            return Epoch(self.trainer, validation_interval(self.every) or 100)  # any number without validation
        return itertools.count(self.trainer.global_step * self.trainer.accumulate_grad_batches)

    def batches_of(self, trainer: Trainer) -> PixelBatches:
        """Return the part of the batches that belongs to the process of a Trainer."""
        return self.batches.for_rank(trainer.global_rank, trainer.world_size)

    def val_dataloader(self) -> list[int]:
        return [] if self.validation is None else [0]  # `validation_step` chooses the view

    def test_dataloader(self) -> range:
        return range(len(self.test))

    def predict_dataloader(self) -> range:
        return range(len(self.test))

    @functools.cached_property
    def test(self) -> Views:
        """Views of `trainer.test` and `trainer.predict`, which are read once.

        Raises:
            NerfroError: the data module has no such views.
        """
        if self._load_test is None:
            raise NerfroError("the data have no test views; give RayDataModule(..., load_test=lambda: views)")
        return self._load_test()

    def due_view(self, step: int) -> int | None:
        """Return the view of the next validation image if one is due in a step; the views take turns."""
        image, since = divmod(step, max(self.every, 1))
        return image % len(self.validation or [0]) if since < validation_interval(self.every) else None

    def transfer_batch_to_device(self, batch: int, device: torch.device, dataloader_idx: int) -> Batch | int:
        assert self.trainer is not None
        if not self.trainer.training:
            return batch
        return self._batch(batch) if self._ahead is None else self._ahead(batch)

    def _batch(self, step: int) -> Batch:
        """Make the batch of a step."""
        return self.tracer.trace(self.batches.draw(step % self._overfit_batches if self._overfit_batches else step))

    def teardown(self, stage: str) -> None:
        self.end_thread()
        self.batches.release_memory()

    def on_exception(self, exception: BaseException) -> None:
        self.end_thread()

    def prefetch(self) -> None:
        """Begin to make the batch of the next step; the density grid is up to date."""
        if self._ahead is not None:
            self._ahead.begin_next()

    def end_thread(self) -> None:
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None


class Epoch:
    """Numbers of the training steps until the next validation, for a Trainer that validates after each epoch.

    Args:
        trainer: Trainer of the run.
        num_steps: number of steps of an epoch.
    """

    def __init__(self, trainer: Trainer, num_steps: int) -> None:
        self._trainer, self._num_steps = trainer, num_steps

    def __len__(self) -> int:
        return self._num_steps

    def __iter__(self) -> Iterator[int]:
        first = self._trainer.global_step * self._trainer.accumulate_grad_batches
        return iter(range(first, first + self._num_steps))


Made = TypeVar("Made")


class Prefetcher(Generic[Made]):
    """Make the batch of the next step in a thread. The batches do not depend on the thread.

    The thread uses one core, and kernels release Python and the threads of Numba (`kernels.compilation`). When idle,
    the thread helps with the current step (`kernels.compilation.share`).

    Args:
        make: function that makes the batch of a step.
        shares_steps: whether threads of Python share each step and each batch, one for each core of PyTorch. PyTorch
            then uses one core in each of them, because small operators divide badly (docs/lab/threads.md).
    """

    def __init__(self, make: Callable[[int], Made], shares_steps: bool = True) -> None:
        self._make = torch.no_grad()(make)
        self._step, self._begun = -1, Future[Made]()
        # PyTorch has a number of threads per thread, and new threads inherit the last one.
        self._num_threads = torch.get_num_threads()
        # The last helper makes the batches, because the others are asked first.
        self._helpers = start_helpers(max(1, self._num_threads - 1) if shares_steps else 1)
        self._thread = self._helpers[-1]
        if shares_steps:
            torch.set_num_threads(1)

    def __call__(self, step: int) -> Made:
        """Return the batch of a step; errors of the thread are raised here."""
        if self._step != step:
            self._begin(step)
        return self._begun.result()

    def begin_next(self) -> None:
        """Begin to make the batch that follows the last one."""
        self._begin(self._step + 1)

    def _begin(self, step: int) -> None:
        self._step, self._begun = step, self._thread.submit(self._make, step)

    def close(self) -> None:
        """End the threads, and return their cores to PyTorch."""
        end_helpers(self._helpers)
        torch.set_num_threads(self._num_threads)


def multiplies_large_matrices(renderer: Renderer) -> bool:
    """Return whether matrix products take most of a step, so that all threads of PyTorch pay."""
    linear = (module for module in renderer.modules() if isinstance(module, nn.Linear))
    return sum(module.weight.numel() for module in linear) > _LARGE


def can_prefetch(renderer: Renderer) -> bool:
    """Return whether a thread can trace the rays of the next step: no parameter changes paths, and a core is free."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores > 1 and renderer.traces_on_cpu


def validation_interval(every: int) -> int:
    """Return the number of steps between two validations, given the number between two images; 0 for never."""
    # There are five validations for each image, so that the curve has more points; each costs a few steps.
    return 0 if every == 0 else max(1, every // 5)
