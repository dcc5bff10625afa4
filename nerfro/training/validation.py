"""Validation during training, and a warning about overfitting."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from tqdm import tqdm

from nerfro.camera.exposure import fit_gain
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.rendering import Renderer
from nerfro.subdivision import PixelRays, Subdivision, contrast, subdivide
from nerfro.training.module import TrainingModule
from nerfro.types import Batch, mean_per_pixel

# Number of validation pixels, and largest number of their views.
_NUM_PIXELS, _MAX_VIEWS = 2048, 32
# A model overfits if validation PSNR is _LOST dB below its maximum while training PSNR has increased by _GAINED dB, or
# if validation PSNR is _GAP dB below training PSNR. Chosen on photographs and rendered scenes: the gap is 0 to 2 dB for
# good runs, and 6 to 9 dB with floating density in front of the cameras.
_LOST, _GAINED, _GAP = 1.0, 0.5, 4.0


@dataclass(frozen=True)
class ValidationPixels:
    """Pixels of validation views, the same ones in each validation so that scores can be compared.

    Attributes:
        cameras: cameras of the validation views.
        index: numbers of the pixels, view * H * W + row * W + column.
        rgb: colours in the photographs, sRGB in [0, 1].
        contrast: contrast to the neighbouring pixels, see `subdivision.contrast`.
    """

    cameras: Cameras
    index: Int[Tensor, "R"]
    rgb: Float[Tensor, "R 3"]
    contrast: Float[Tensor, "R"]

    @classmethod
    def of(cls, views: Views, seed: int = 0) -> ValidationPixels:
        """Draw random usable pixels, the same number from each view."""
        generator = np.random.default_rng([seed, 0])
        chosen = views.spread(_MAX_VIEWS)
        size, indices, colours, contrasts = views.cameras.height * views.cameras.width, [], [], []
        for view in chosen:
            allowed = np.arange(size)
            if views.usable is not None:
                usable = torch.as_tensor(views.usable[view]).flatten().numpy() == 1
                allowed = np.flatnonzero(usable) if usable.any() else allowed
            drawn = torch.from_numpy(generator.choice(allowed, min(_NUM_PIXELS // len(chosen), len(allowed)), False))
            indices.append(view * size + drawn)
            image = views.images[view].reshape(-1, 3)
            colours.append(image[drawn])
            contrasts.append(contrast(image.__getitem__, views.cameras, drawn))
        return cls(views.cameras, *map(torch.cat, (indices, colours, contrasts)))

    def rays(self, renderer: Renderer, subdivision: Subdivision) -> PixelRays:
        """Return rays through the pixels, subdivided as in training."""
        contrast = self.contrast.to(renderer.scene.device)
        return subdivide(
            self.cameras.to(renderer.scene.device),
            self.index.to(renderer.scene.device),
            subdivision,
            lambda rays, view: renderer.path_sampler(rays, renderer.scene.medium),
            lambda rays, view: renderer.exit_directions(rays),
            lambda rows: contrast[rows],
        )

    def psnr(self, renderer: Renderer, subdivision: Subdivision) -> Float[Tensor, ""]:
        """Compute the PSNR of the rendered pixels in dB; learned exposures are replaced by fitted gains of each view.

        Args:
            renderer: model.
            subdivision: which pixels get several rays.
        """
        found, rgb = self.rays(renderer, subdivision), self.rgb.to(renderer.scene.device)
        radiance = mean_per_pixel(renderer.radiance(found.rays), found.pixel, len(rgb))
        if renderer.scene.camera.exposure is None:
            return _psnr(renderer.scene.colour_space.to_display(radiance), rgb)
        views = self.index.to(renderer.scene.device) // (self.cameras.height * self.cameras.width)
        gains, colour_space = torch.ones_like(radiance), renderer.scene.colour_space
        for view in views.unique():
            gains[views == view] = fit_gain(colour_space.to_srgb, radiance[views == view], rgb[views == view])
        return _psnr(colour_space.to_display(radiance, gains), rgb)


class OverfittingWarning(Callback):
    """Print a warning once if the model overfits.

    The model overfits if, in two successive validations, validation PSNR is 1 dB below its maximum while training PSNR
    has increased by 0.5 dB, or if validation PSNR is 4 dB below training PSNR. Training PSNR is averaged over all
    batches since the last validation.

    Attributes:
        comparable: whether validation and training PSNR can be compared. If cameras are refined, validation views have
            less accurate cameras than training views.
        warned: whether the warning was printed.
    """

    def __init__(self) -> None:
        self.comparable = True
        # Sum of the mean squared errors of batches since the last validation, and number of batches.
        self._error, self._steps = 0.0, 0
        self._best, self._best_step, self._training_at_best = -math.inf, 0, -math.inf
        self._overfitted = self.warned = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        self.comparable = not pl_module.scene.camera.moves

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if isinstance(outputs, Mapping) and "squared_error" in outputs:
            self._error, self._steps = self._error + outputs["squared_error"], self._steps + 1

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self._steps or "val/psnr" not in trainer.callback_metrics:
            return
        training = -10 * math.log10(max(float(self._error) / self._steps, 1e-10))
        self._error, self._steps = 0.0, 0
        message = self.judge(trainer.global_step, float(trainer.callback_metrics["val/psnr"]), training)
        if message is not None and trainer.is_global_zero:
            tqdm.write(f"nerfro: {message}")  # above the bar

    def judge(self, step: int, validation: float, training: float) -> str | None:
        """Return the warning after a validation, or None.

        Args:
            step: number of completed steps.
            validation, training: PSNR of validation pixels and of training pixels, dB.
        """
        if validation > self._best:
            self._best, self._best_step, self._training_at_best = validation, step, training
        lost = self._best - validation >= _LOST and training - self._training_at_best >= _GAINED
        overfits = lost or (self.comparable and training - validation >= _GAP)
        warns, self._overfitted = overfits and self._overfitted and not self.warned, overfits
        if not warns:
            return None
        self.warned = True
        decrease = f", {self._best - validation:.1f} dB less than after {self._best_step}" if lost else ""
        shorter = f", or train for {self._best_step} steps" if lost else ""
        return (
            f"the model overfits: validation PSNR is {validation:.1f} dB after {step} steps{decrease}; training PSNR "
            f"is {training:.1f} dB. Take more photographs, check the poses and, for glass, surface and index "
            f"(medium...){shorter}; see docs/tutorials/photographs.md, Few photographs"
        )

    def state_dict(self) -> dict[str, Any]:
        names = ("_best", "_best_step", "_training_at_best", "_overfitted", "warned")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        vars(self).update(state_dict)


def _psnr(prediction: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]) -> Float[Tensor, ""]:
    return -10 * torch.log10((prediction - target).square().mean())
