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
from nerfro.core.cameras import Cameras
from nerfro.core.types import Batch, mean_per_pixel
from nerfro.data.base import Views
from nerfro.rendering import RayTracer, Renderer
from nerfro.rendering.ray_tracer import PixelRays
from nerfro.samplers.subdivision import Subdivision, contrast
from nerfro.training.module import TrainingModule

# Number of validation pixels, and largest number of their views.
_NUM_PIXELS, _MAX_VIEWS = 2048, 32
# Difference of training and validation PSNR in dB from which a model overfits. Chosen on photographs and rendered
# scenes: good runs have 0 to 2 dB, and runs with floating density in front of the cameras have 6 to 9 dB.
_GAP = 4.0


@dataclass(frozen=True)
class ValidationPixels:
    """Pixels of validation views, the same ones in each validation so that scores can be compared.

    Attributes:
        cameras: cameras of the validation views.
        index: numbers of the pixels, view * H * W + row * W + column.
        rgb: colours in the photographs, sRGB in [0, 1].
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


class OverfittingWarning(Callback):
    """Print a warning once if validation PSNR is 4 dB below training PSNR in two successive validations.

    Training PSNR is averaged over all batches since the last validation. There is no warning if cameras are refined,
    because validation views then have less accurate cameras than training views.
    """

    def __init__(self) -> None:
        # Sum of the mean squared errors of batches since the last validation, and number of batches.
        self._error, self._steps = 0.0, 0
        self._num_gaps = 0  # number of successive validations with a large difference
        self._best = -math.inf, 0  # highest validation PSNR in dB, and its step

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if isinstance(outputs, Mapping) and "squared_error" in outputs:
            self._error, self._steps = self._error + outputs["squared_error"], self._steps + 1

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        if not self._steps or "val/psnr" not in trainer.callback_metrics or pl_module.scene.camera.moves:
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
        self._best = max(self._best, (validation, step))
        if self._num_gaps < 2:  # otherwise the warning was printed
            self._num_gaps = self._num_gaps + 1 if training - validation >= _GAP else 0
            if self._num_gaps == 2:
                best, best_step = self._best
                return (
                    f"the model overfits: validation PSNR is {validation:.1f} dB after {step} steps, and was highest "
                    f"({best:.1f} dB) after {best_step}; training PSNR is {training:.1f} dB. Take more photographs, "
                    "check the poses and, for glass, surface and index (medium...); see "
                    "docs/tutorials/photographs.md, Few photographs"
                )
        return None

    def state_dict(self) -> dict[str, Any]:
        return {"num_gaps": self._num_gaps, "best": self._best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._num_gaps = state_dict["num_gaps"]
        self._best = state_dict.get("best", self._best)  # checkpoints of earlier versions have none


def _psnr(prediction: Float[Tensor, "Q 3"], target: Float[Tensor, "Q 3"]) -> Float[Tensor, ""]:
    return -10 * torch.log10((prediction - target).square().mean())
