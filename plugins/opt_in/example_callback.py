"""Template: a callback of your own in one file. Use it with `+callbacks=gradient_norm`.

The file is used only if the environment variable `NERFRO_PLUGINS` names its folder, or if you copy it to `plugins/`,
because importing Lightning takes seconds.
"""

from __future__ import annotations

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch.optim import Optimizer

from nerfro.parts import register


@register("callbacks", "gradient_norm")
class GradientNorm(Callback):
    """Log the norm of the gradients of all parameters, every `trainer.log_every_n_steps` steps."""

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        if pl_module.is_logged_step:  # other steps have no entry in the log
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            norm = torch.nn.utils.get_total_norm(gradients)
            pl_module.log("train/gradient_norm", norm)
