"""Template: a callback of your own in one file. Use it with `+callbacks=gradient_norm`.

The file is used only if the environment variable `NERFRO_PLUGINS` names its folder, or if you copy it to `plugins/`,
because importing Lightning takes seconds.
"""

from __future__ import annotations

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch.optim import Optimizer

from nerfro.parts import Count, register


@register("callbacks", "gradient_norm")
class GradientNorm(Callback):
    """Log the norm of the gradients of all parameters.

    Args:
        every: number of steps between two entries of the log.
    """

    def __init__(self, every: Count = 100) -> None:
        self.every = every

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        if trainer.global_step % self.every == 0:
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            norm = torch.nn.utils.get_total_norm(gradients)
            pl_module.log("train/gradient_norm", norm)
