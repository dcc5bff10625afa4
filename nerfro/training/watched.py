"""Views that are not trained on, while others are: what they show, and whether they fall behind."""

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

# Pixels that are looked at, of at most so many views: the same ones each time, or their scores could not be compared.
_NUM_PIXELS, _MOST_VIEWS = 2048, 32
# What falls behind has lost so many dB of its best while training pixels gained so many, or is so many dB below them.
# Healthy runs end 0 to 2 dB below, on photographs and on rendered scenes; clouds before the cameras 6 and 9.
_LOST, _GAINED, _LAG = 1.0, 0.5, 4.0


@dataclass(frozen=True)
class WatchedPixels:
    """Some pixels of views that are not trained on; `index` is view * H * W + row * W + column."""

    cameras: Cameras
    index: Int[Tensor, "R"]
    rgb: Float[Tensor, "R 3"]  # sRGB in [0, 1]
    contrast: Float[Tensor, "R"]  # with the pixels around; see `subdivision.contrast`

    @classmethod
    def of(cls, views: Views, seed: int = 0) -> WatchedPixels:
        """Random pixels, equally many of each view, of those that may be trained on where masks say so."""
        generator = np.random.default_rng([seed, 0])
        chosen = np.unique(np.linspace(0, len(views) - 1, _MOST_VIEWS).round().astype(int)).tolist()
        size, indices, colours, contrasts = views.cameras.height * views.cameras.width, [], [], []
        for view in chosen:
            allowed = np.arange(size)
            if views.usable is not None:
                usable = torch.as_tensor(views.usable[view]).flatten().numpy() == 1
                allowed = np.flatnonzero(usable) if usable.any() else allowed
            drawn = torch.from_numpy(generator.choice(allowed, min(_NUM_PIXELS // len(chosen), len(allowed)), False))
            indices.append(view * size + drawn)
            picture = views.images[view].reshape(-1, 3)
            colours.append(picture[drawn])
            contrasts.append(contrast(picture.__getitem__, views.cameras, drawn))
        return cls(views.cameras, *map(torch.cat, (indices, colours, contrasts)))

    def rays(self, renderer: Renderer, subdivision: Subdivision) -> PixelRays:
        """The rays that training gives such pixels."""
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
        """Peak signal-to-noise ratio of the model's pixels, dB; learned exposures are replaced by the best gains.

        Args:
            model: that renders the pixels.
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


class FallingBehind(Callback):
    """Says once when pixels of views that are not trained on fall behind those that are.

    That is so if in two looks, one after the other, they have lost 1 dB of their best, while training pixels have
    gained half a dB since; or if they are 4 dB below them. PSNR of training pixels is that of all batches since the
    last look.

    Attributes:
        comparable: whether the difference of both tells anything. Where cameras of training views learn, those of other
            views do not.
        told: whether it has said so.
    """

    def __init__(self) -> None:
        self.comparable = True
        self._error, self._steps = 0.0, 0  # of batches since the last look: sum of mean squared errors, and how many
        self._best, self._best_step, self._training_then = -math.inf, 0, -math.inf
        self._behind = self.told = False

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

    def judge(self, step: int, held: float, training: float) -> str | None:
        """What is to be told after a look, if anything.

        Args:
            step: how many steps are done.
            held, training: PSNR of pixels of views that are not trained on, and of those that are, dB.
        """
        if held > self._best:
            self._best, self._best_step, self._training_then = held, step, training
        lost = self._best - held >= _LOST and training - self._training_then >= _GAINED
        behind = lost or (self.comparable and training - held >= _LAG)
        told, self._behind = behind and self._behind and not self.told, behind
        if not told:
            return None
        self.told = True
        fallen = f", {self._best - held:.1f} less than after {self._best_step}" if lost else ""
        shorter = f", or train for {self._best_step} steps" if lost else ""
        return (
            f"views that are not trained on fall behind: {held:.1f} dB after {step} steps{fallen}; training pixels "
            f"have {training:.1f}. Take more photographs, check poses and, of glass, surface and index "
            f"(medium...){shorter}; see docs/real.md, Few photographs"
        )

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("_best", "_best_step", "_training_then", "_behind", "told")}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        vars(self).update(state_dict)


def _psnr(prediction: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]) -> Float[Tensor, ""]:
    return -10 * torch.log10((prediction - target).square().mean())
