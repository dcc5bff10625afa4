"""The training of a model as a LightningModule: losses, optimizer, schedules and logging."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Timer
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.paths import user_path
from nerfro.core.types import Batch
from nerfro.data.base import Views
from nerfro.losses.base import Loss, Objective, ObjectiveValue
from nerfro.optimizers.config import OptimizerConfig
from nerfro.registry.allowed import plain, validate
from nerfro.registry.registration import discover
from nerfro.rendering import Renderer, Scene
from nerfro.training.checks import Updates
from nerfro.training.config import build_each
from nerfro.training.inputs import INPUTS, inputs_of
from nerfro.training.run_folder import first_not_finite, load_run, restore


class TrainingModule(LightningModule):
    """Train a model, a `Renderer` with a `Scene`, on batches of pixels.

    Args:
        renderer: the model that `model=` chooses.
        losses: training losses by name.
        optimizer: settings of the optimizer and of the learning rate schedule.
        callbacks: callbacks that are a part of the method; every Trainer adds them to its own.
        configuration: resolved configuration of the run (YAML), which every checkpoint contains.
        inputs: description of the inputs of the run, which every checkpoint contains, see `training.inputs`.

    Attributes:
        is_logged_step: whether the current training step has an entry in the log: the first step, and the last of every
            `log_every_n_steps` steps, as in Lightning. Values that are logged in other steps are dropped.
    """

    def __init__(
        self,
        renderer: Renderer,
        losses: Mapping[str, Loss],
        optimizer: OptimizerConfig,
        callbacks: Sequence[Callback] = (),
        configuration: str | None = None,
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self._callbacks, self._configuration, self._inputs = list(callbacks), configuration, inputs
        self.renderer = renderer
        self.objective = Objective(losses)
        self.optimizer_config = optimizer
        optimizer.freeze_parameters(renderer.parameters_by_name())
        self.is_logged_step = True
        self._logged: set[str] = set()
        self._dropped: set[str] = set()
        self._updates: Updates | None = None

    @classmethod
    def of(
        cls,
        renderer: Renderer,
        config: DictConfig,
        callbacks: Sequence[Callback] = (),
        views: Views | None = None,
    ) -> TrainingModule:
        """Create the module from a configuration, and the training views if they are known."""
        configuration = OmegaConf.to_yaml(config, resolve=True)
        optimizer = validate(OptimizerConfig, plain(config.optimizer), "optimizer.")
        inputs = inputs_of(config, views)
        return cls(renderer, build_each("loss", config.loss), optimizer, callbacks, configuration, inputs)

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, map_location: str | torch.device = "cpu"
    ) -> TrainingModule:
        """Load the module of a checkpoint, from the configuration in the checkpoint.

        The module has no callbacks, so use `nerfro.build` to continue a training.

        Args:
            checkpoint_path: file of the checkpoint.
            map_location: device of the module.

        Raises:
            NerfroError: the checkpoint cannot be read.
        """
        discover()
        checkpoint, config = load_run(user_path(checkpoint_path))
        return cls.of(restore(checkpoint, config), config).to(map_location)

    def configure_callbacks(self) -> list[Callback]:
        return self._callbacks

    def __getstate__(self) -> dict[str, Any]:
        # Averages of weights copy the module; the callbacks hold the photographs.
        return {**super().__getstate__(), "_callbacks": []}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if (name := first_not_finite(self.state_dict())) is not None:
            raise NerfroError(
                f"the model diverged before step {self.global_step}: {name} has infinite numbers or NaN; an earlier "
                "checkpoint is kept; set a lower optimizer.learning_rate, or another seed"
            )
        if self._configuration is not None:
            checkpoint["nerfro_config"] = self._configuration
        if self._inputs is not None:
            checkpoint[INPUTS] = self._inputs

    @property
    def scene(self) -> Scene:
        """All learned parameters of the world."""
        return self.renderer.scene

    def setup(self, stage: str) -> None:
        if self.trainer.datamodule is None:  # type: ignore[attr-defined]
            raise NerfroError(
                f"trainer.{stage} needs pixels and views; add datamodule=data, as nerfro.build returns it"
            )
        if self.trainer.world_size > 1 and not self.renderer.trains_in_parallel:
            raise NerfroError(f"{type(self.renderer).__name__} trains in one process; set trainer.devices=1")

    def on_fit_start(self) -> None:
        require_monitored(self.trainer)
        self._updates = Updates(self.renderer.parameters_by_name())

    def on_train_start(self) -> None:  # after the phases before training
        every: int = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        self.is_logged_step = self.global_step == 0 or (self.global_step + 1) % every == 0
        if self.global_step > 0:
            self._updates = None  # only a whole run tells which parameters never learn
        elif self._updates is not None:
            starts = {
                parameter: self.optimizer_config.group(group).start or 0
                for group, parameters in self.parameter_groups().items()
                for parameter in parameters
            }
            self._updates.warn_of_late_starts(self.trainer.max_steps, starts)

    def on_train_end(self) -> None:
        if self._updates is None or self.global_step == 0:
            return
        self._updates.warn_of_unchanged()
        if names := sorted(self._dropped - self._logged):
            warn(f"{first_of(names)} has no entry in the log: log in steps in which module.is_logged_step is true")

    def training_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """Compute the loss of a batch, and the mean squared error of its pixels (sRGB)."""
        value = self.objective(self.renderer.render_batch(batch), batch, self.renderer.scene, self.global_step)
        self._log_step(value)
        return {"loss": self._with_all_parameters(value.total), "squared_error": value.squared_error}

    def _with_all_parameters(self, total: Tensor) -> Tensor:
        """Let the loss depend on all parameters if there are several processes.

        They wait for each other's gradients of all parameters, also of those that a batch does not use.
        """
        if self._trainer is None or self.trainer.world_size == 1:
            return total
        learned = [parameter.sum().to(total) for parameter in self.parameters() if parameter.requires_grad]
        return total + 0 * torch.stack(learned).sum()

    def _log_step(self, value: ObjectiveValue) -> None:
        """Log a step, but only in steps with output, because logging takes a tenth of the time of a step."""
        if not self.is_logged_step:
            return
        self.log_dict({f"weight/{name}": weight for name, weight in value.weights.items()})
        self.log_dict({f"loss/{name}": loss for name, loss in value.losses.items()})
        self.log("train/psnr", -10 * torch.log10(value.squared_error))
        self.log("loss/total", value.total)
        self.log_dict({f"scene/{name}": measurement for name, measurement in self.scene.measurements().items()})

    def log(self, name: str, *args: Any, **kwargs: Any) -> None:
        """Log a value, but only in training steps with output, see `is_logged_step`."""
        if self.is_logged_step or not self.trainer.training:
            self._logged.add(name)
            super().log(name, *args, **kwargs)
        else:
            self._dropped.add(name)

    def on_train_batch_start(self, batch: Batch, batch_index: int) -> None:
        progress = self.renderer.begin_step(training_progress(self.trainer))
        factor = learning_rate_factor(self.global_step, progress, self.optimizer_config)
        for group in self.trainer.optimizers[0].param_groups:
            # A scheduler, or an optimizer of a derived class, has rates of its own.
            if "start" in group and not self.trainer.lr_scheduler_configs:  # type: ignore[attr-defined]
                group["lr"] = 0.0 if self.global_step < group["start"] else group["initial_lr"] * factor
        # At the end of the previous step, the update would follow the checkpoint, and a resumed run would miss it.
        if self.global_step > 0:
            draws = replace(batch.draws, step=self.global_step)  # a repeated batch repeats its number
            self.renderer.point_sampler.update(list(self.renderer.scene.fields), draws)  # type: ignore[arg-type]
        self.trainer.datamodule.prefetch()  # type: ignore[attr-defined]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if self.trainer.lr_scheduler_configs:  # type: ignore[attr-defined] # the rates are those of the scheduler
            for group in optimizer.param_groups:
                if self.global_step < group.get("start", 0):
                    for parameter in group["params"]:
                        parameter.grad = None

    def on_train_batch_end(self, outputs: object, batch: Batch, batch_index: int) -> None:  # after the callbacks
        every: int = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        self.is_logged_step = (self.global_step + 1) % every == 0

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return all learned parameters by optimizer group.

        Raises:
            NerfroError: a pattern of `optimizer.groups` matches no parameter.
        """
        return self.optimizer_config.grouped(self.renderer.parameters_by_name())

    @property
    def learning_rate(self) -> float:
        """Common initial learning rate, which the learning-rate finder of Lightning sets."""
        return self.optimizer_config.learning_rate

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        self.optimizer_config = replace(self.optimizer_config, learning_rate=rate)

    def make_optimizer(self) -> torch.optim.Optimizer:
        """Create the optimizer of all learned parameters."""
        # Lightning cannot clip the gradients of a fused optimizer under mixed precision.
        fused = self._trainer is None or not self._trainer.gradient_clip_val
        return self.optimizer_config.optimizer_of(self.parameter_groups(), fused)

    def configure_optimizers(self) -> Any:
        optimizer = self.make_optimizer()
        scheduler = self.optimizer_config.scheduler_of(optimizer)
        if scheduler is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def validation_step(self, batch: int, batch_index: int) -> dict[str, Any] | None:
        if not self.trainer.is_global_zero:
            return None  # one process evaluates, the others wait
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        views, view = data.validation, data.due_view(self.global_step)
        # Mixed precision is off for rays, because rounded directions would miss their pixels.
        with torch.autocast(self.device.type, enabled=False):
            psnr = data.validation_pixels.psnr(self.renderer, data.subdivision)
            rays = None if view is None else views.cameras.to(self.device).image_rays(view)
        self.log("val/psnr", psnr, prog_bar=True, batch_size=1, rank_zero_only=True)
        if rays is None:
            return None
        target = views.images[view].to(self.device).clamp(0, 1)
        rendered = self.renderer.render(rays)
        prediction = self.scene.colour_space.to_display(rendered.radiance).reshape(target.shape)
        depth, opacity = (m.reshape(target.shape[:2]) for m in (rendered.depth / views.cameras.far, rendered.opacity))
        return {"view": view, "prediction": prediction, "target": target, "depth": depth, "opacity": opacity}

    def test_step(self, batch: int, batch_index: int) -> None:
        target = self.trainer.datamodule.test.images[batch].to(self.device).clamp(0, 1)  # type: ignore[attr-defined]
        error = (self.predict_step(batch, batch_index) - target).square().mean()
        self.log("test/psnr", -10 * torch.log10(error), batch_size=1)

    def predict_step(self, batch: int, batch_index: int) -> Float[Tensor, "H W 3"]:
        """Render a test view; sRGB in [0, 1]."""
        cameras = self.trainer.datamodule.test.cameras.to(self.device)  # type: ignore[attr-defined]
        with torch.autocast(self.device.type, enabled=False):  # rounded directions would miss their pixels
            radiance = self.renderer.render(cameras.image_rays(batch)).radiance
        return self.scene.colour_space.to_display(radiance).reshape(cameras.height, cameras.width, 3)


def require_monitored(trainer: Trainer) -> None:
    """Refuse callbacks that monitor a score that validation does not log, or any score if the run has no validation.

    Raises:
        NerfroError: a callback waits for a score that is never computed.
    """
    data = trainer.datamodule  # type: ignore[attr-defined]
    validates = data.validation is not None and data.every > 0 and trainer.limit_val_batches != 0  # type: ignore[attr-defined]
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        monitor = str(getattr(callback, "monitor", None))
        if monitor.startswith("val/") and monitor != "val/psnr":
            raise NerfroError(
                f"{type(callback).__name__} monitors {monitor}, but validation logs only val/psnr; values that a "
                "callback of your own logs need another prefix"
            )
        if monitor.startswith("val/") and not validates:
            raise NerfroError(
                f"{type(callback).__name__} monitors {monitor}, but the run has no validation; give validation views "
                "(a split `val`, or batches.num_validation_views=2), and evaluation.every > 0"
            )


def training_progress(trainer: Trainer) -> float:
    """Return the progress of a run in [0, 1]: the larger of the fractions of `max_steps` and of `max_time`.

    With `max_time`, schedules depend on the speed of the machine.
    """
    progress = trainer.global_step / trainer.max_steps if trainer.max_steps > 0 else 0.0
    timer = next((c for c in trainer.callbacks if isinstance(c, Timer)), None)  # type: ignore[attr-defined]
    if timer is not None:
        elapsed, remaining = timer.time_elapsed(), timer.time_remaining()
        if remaining is not None and elapsed + remaining > 0:
            progress = max(progress, elapsed / (elapsed + remaining))
    return min(progress, 1.0)


def learning_rate_factor(step: int, progress: float, config: OptimizerConfig) -> float:
    """Return the factor of the initial learning rates: log-linear decay times the sine warm-up of mip-NeRF."""
    decayed = max(progress - config.decay_start, 0.0) / (1.0 - config.decay_start)
    factor = (config.final_learning_rate / config.learning_rate) ** decayed
    if config.warmup_steps > 0:
        ascent = math.sin(0.5 * math.pi * min(step / config.warmup_steps, 1.0))
        factor *= config.warmup_factor + (1.0 - config.warmup_factor) * ascent
    return factor
