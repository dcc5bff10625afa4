"""Log of a run in TensorBoard and W&B: learning rates, memory, images, and histograms of samples."""

from __future__ import annotations

import csv
import functools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.types import Exits, Rays, Rendering
from nerfro.evaluation.image_metrics import triptych
from nerfro.evaluation.path_plot import image_of_paths
from nerfro.files.lat_long import directions
from nerfro.files.reading import reading
from nerfro.rendering import Scene
from nerfro.training.module import TrainingModule

_NUM_RAYS = 128  # largest number of rays for the histograms
# Charts of TensorBoard's page "Custom Scalars".
_LAYOUT = {
    "training": {
        "PSNR": ["Multiline", ["train/psnr", "val/psnr"]],
        "losses": ["Multiline", ["loss/.*"]],
        "weights of losses": ["Multiline", ["weight/.*"]],
    }
}


def keep_rows(logger: CSVLogger, num_steps: int) -> None:
    """Keep the rows of a run that is resumed; a new log of Lightning begins by deleting them.

    Args:
        logger: the new log.
        num_steps: number of steps of the checkpoint. Rows of later steps are dropped, because the run repeats them.
    """
    file = Path(logger.log_dir, "metrics.csv")
    if file.is_file():
        with reading(file, advice="remove it"), file.open(newline="", encoding="utf-8") as stream:
            # The row of training step n, counted from 0, and that of the scores after n steps have the same number.
            # The last row of a killed run may be cut off.
            whole = (row for row in csv.DictReader(stream) if (row["step"] or "").isdecimal())
            rows = [row for row in whole if int(row["step"]) < num_steps + (not row.get("loss/total"))]
        logger.experiment.metrics += [{name: value for name, value in row.items() if value} for row in rows]
        logger.save()


class TrainingLog(Callback):
    """Log settings (Weights & Biases), learning rates and memory in training, and images of validation views.

    The images are the view with its photograph and the error, depth and opacity, the background, and the paths of a few
    rays of the middle row. Histograms show the arc lengths of the samples of these rays for each sampling level.
    """

    def __init__(self, config: DictConfig) -> None:
        self._config = config

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for logger in trainer.loggers:
            _omit_epoch(logger)
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_custom_scalars(_LAYOUT)
            if isinstance(logger, WandbLogger):
                logger.log_hyperparams(OmegaConf.to_container(self._config, resolve=True))  # type: ignore[arg-type]

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any, **__: Any) -> None:
        for group in trainer.optimizers[0].param_groups:
            pl_module.log(f"optimizer/learning_rate/{group.get('name', 'common')}", group["lr"])
        pl_module.log("train/peak_memory_gib", peak_memory(pl_module.device) / 2**30)
        if trainer.global_step == 1 < trainer.log_every_n_steps:  # type: ignore[attr-defined]
            first = {name: float(value) for name, value in trainer.callback_metrics.items()}
            for logger in trainer.loggers:  # Lightning logs at the end of each interval, but not its first step
                logger.log_metrics(first, 0)

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any, **__: Any
    ) -> None:
        if not outputs:
            return
        assert isinstance(pl_module, TrainingModule)
        renderer = pl_module.renderer
        loggers = [logger for logger in trainer.loggers if isinstance(logger, (TensorBoardLogger, WandbLogger))]
        if not loggers:
            return
        rays = _middle_row(trainer.datamodule.validation.cameras.to(pl_module.device), outputs["view"])  # type: ignore[attr-defined]
        with torch.inference_mode():
            renderings: list[Rendering] = renderer(rays)
        maps = torch.cat([outputs["depth"], outputs["opacity"]], 1)[..., None].expand(-1, -1, 3)
        images = {
            "val/prediction_reference_error": _to_8bit(triptych(outputs["prediction"], outputs["target"])),
            "val/depth_opacity": _to_8bit(maps),
            "val/sky": sky(renderer.scene),
        }
        if not renderer.scene.medium.is_vacuum:
            shown = torch.linspace(0, len(rays) - 1, min(12, len(rays))).long().to(rays.origins.device)
            images["val/paths"] = image_of_paths(renderings[-1].path.select_rays(shown), renderer.scene.medium)
        for logger in loggers:
            _log_images(logger, images, trainer.global_step)
            for level, rendering in enumerate(renderings):
                # The samples of rays that miss the object have intervals of zero length at far.
                s = rendering.samples.s[rendering.samples.deltas > 0]
                if len(s) > 0:
                    _log_histogram(logger, f"val/arc_length_level_{level}", s, trainer.global_step)


def peak_memory(device: torch.device) -> int:
    """Return the peak memory in bytes: of tensors on a GPU, of the process on a CPU; 0 if unknown."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes on other systems


@torch.inference_mode()
def sky(scene: Scene) -> UInt8[np.ndarray, "H 2*H 3"]:
    """Render the background as a lat-long image (see files/lat_long.py)."""
    was_training = scene.background.training
    scene.background.eval()
    try:
        return _to_8bit(scene.colour_space.to_srgb(scene.background(Exits(directions(128).to(scene.device)))))  # rows
    finally:
        scene.background.train(was_training)


def _middle_row(cameras: Cameras, view: int) -> Rays:
    """Return rays of at most `_NUM_RAYS` evenly spaced pixels of the middle row of a view."""
    rays = cameras.image_rays(view)
    first = cameras.height // 2 * cameras.width
    return rays[first : first + cameras.width : -(-cameras.width // _NUM_RAYS)]


def _to_8bit(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (image.detach().float().clamp(0, 1) * 255).round().byte().cpu().numpy()


def _omit_epoch(logger: Logger) -> None:
    """Log no `epoch`, which Lightning adds to all values; a run has a single epoch."""
    log_metrics = logger.log_metrics

    @functools.wraps(log_metrics)
    def without_epoch(metrics: dict[str, float], step: int | None = None) -> None:
        log_metrics({name: value for name, value in metrics.items() if name != "epoch"}, step)

    logger.log_metrics = without_epoch  # type: ignore[method-assign]


def _log_images(logger: Logger, images: Mapping[str, UInt8[np.ndarray, "H W 3"]], step: int) -> None:
    for name, image in images.items():
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, image, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(name, [image], step=step)


def _log_histogram(logger: Logger, name: str, values: Tensor, step: int) -> None:
    flat = values.detach().float().flatten().cpu().numpy()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_histogram(name, flat, step)
    elif isinstance(logger, WandbLogger):
        from wandb import Histogram

        logger.log_metrics({name: Histogram(flat)}, step)  # type: ignore[arg-type,dict-item]
