"""Training and validation data as Lightning asks for them."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from lightning.pytorch import LightningDataModule

from nerfro.data.base import Views
from nerfro.training.ray_batches import RayBatches
from nerfro.types import Batch


class RayDataModule(LightningDataModule):
    """Random training pixels, resident on the training device, and one validation view at a time.

    Args:
        batches: of training pixels.
        validation: views to look at while training, or None.
        every: steps between two looks, by which the views are rotated.
    """

    def __init__(self, batches: RayBatches, validation: Views | None, every: int) -> None:
        super().__init__()
        self.batches, self.validation, self.every = batches, validation, every

    def train_dataloader(self) -> RayBatches:
        assert self.trainer is not None  # Lightning attaches it before it asks
        batches = self.batches.to(self.trainer.strategy.root_device)
        # Lightning asks after it has restored a checkpoint, so a resumed run goes on with the batch it would have had.
        batches.first_step = self.trainer.global_step
        return batches

    def val_dataloader(self) -> RotatingView | list[int]:
        return [] if self.validation is None else RotatingView(self)

    def teardown(self, stage: str) -> None:
        self.batches.forget()

    def transfer_batch_to_device(self, batch: Batch | int, device: torch.device, dataloader_idx: int) -> Batch | int:
        return batch  # it is there already


class RotatingView:
    """One validation view each time it is iterated, the next one at the next look."""

    def __init__(self, module: RayDataModule) -> None:
        self._module = module

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[int]:
        module = self._module
        assert module.trainer is not None
        look = module.trainer.global_step // max(module.every, 1)
        yield look % len(module.validation or [0])
