"""What a run shows while it trains, in TensorBoard and W&B: rates and memory, pictures, and where samples lie."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.evaluation.image_grid import triptych
from nerfro.evaluation.path_plot import image_of_paths
from nerfro.files.lat_long import directions
from nerfro.media.analytic import Vacuum
from nerfro.rendering import Scene
from nerfro.training.module import TrainingModule
from nerfro.types import Batch, Exits, Rays, Rendering

_SKY_HEIGHT = 128  # rows of the picture of the sky
_NUM_RAYS = 128  # at most, for the histograms
_NUM_PATHS = 12  # of these, in the picture of bent paths


class TrainingLog(Callback):
    """Logs settings (Weights & Biases), learning rates, memory, and images whenever a validation view is evaluated.

    The pictures are the view beside its photograph and the error, its depth and opacity, the sky, and the paths of a
    few rays through its middle row; the histograms tell at which arc lengths the rays of that row are sampled, for each
    sampling level.
    """

    def __init__(self, config: DictConfig) -> None:
        self._config = config

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger.log_hyperparams(OmegaConf.to_container(self._config, resolve=True))  # type: ignore[arg-type]

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: Batch, batch_idx: int
    ) -> None:
        for name, rate in learning_rates(trainer).items():
            pl_module.log(f"learning_rate/{name}", rate)
        pl_module.log("train/peak_memory_gib", peak_memory(pl_module.device) / 2**30)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: int,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if not outputs:
            return
        assert isinstance(pl_module, TrainingModule)
        renderer = pl_module.renderer
        loggers = [logger for logger in trainer.loggers if isinstance(logger, (TensorBoardLogger, WandbLogger))]
        if not loggers:
            return
        rays = _middle_row(trainer.datamodule.validation.cameras.to(pl_module.device), batch)  # type: ignore[attr-defined]
        with torch.inference_mode():
            renderings: list[Rendering] = renderer(rays)
        maps = torch.cat([outputs["depth"], outputs["opacity"]], 1)[..., None].expand(-1, -1, 3)
        pictures = {
            "val/prediction_reference_error": _to_8bit(triptych(outputs["prediction"], outputs["target"])),
            "val/depth_opacity": _to_8bit(maps),
            "val/sky": sky(renderer.scene),
        }
        if not isinstance(renderer.scene.medium, Vacuum):
            shown = torch.linspace(0, len(rays) - 1, min(_NUM_PATHS, len(rays))).long().to(rays.origins.device)
            pictures["val/paths"] = image_of_paths(renderings[-1].path.of_rays(shown), renderer.scene.medium)
        for logger in loggers:
            _log_pictures(logger, pictures, trainer.global_step)
            for level, rendering in enumerate(renderings):
                # Rays that miss the object have their samples in a span of no length at far.
                s = rendering.samples.s[rendering.samples.deltas > 0]
                if len(s) > 0:
                    _log_histogram(logger, f"samples/arc_length_level_{level}", s, trainer.global_step)


def learning_rates(trainer: Trainer) -> dict[str, float]:
    """Present learning rate of each part of the model that learns (`Renderer.parameter_groups`)."""
    return {group["name"]: group["lr"] for group in trainer.optimizers[0].param_groups}


def peak_memory(device: torch.device) -> int:
    """Most bytes that were used so far: by tensors on a GPU, by the whole process on a CPU; 0 where nobody counts."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes everywhere but there


@torch.inference_mode()
def sky(scene: Scene, height: int = _SKY_HEIGHT) -> UInt8[np.ndarray, "H 2*H 3"]:
    """The background as a lat-long picture (see files/lat_long.py)."""
    was_training = scene.boundary.training
    scene.boundary.eval()
    try:
        return _to_8bit(scene.colour_space.to_srgb(scene.boundary(Exits(directions(height).to(scene.device)))))
    finally:
        scene.boundary.train(was_training)


def _middle_row(cameras: Cameras, view: int) -> Rays:
    """Rays of at most `_NUM_RAYS` pixels of a view's middle row, evenly spread."""
    rays = cameras.image_rays(view)
    first = cameras.height // 2 * cameras.width
    return rays[first : first + cameras.width : -(-cameras.width // _NUM_RAYS)]


def _to_8bit(picture: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (picture.detach().float().clamp(0, 1) * 255).round().byte().cpu().numpy()


def _log_pictures(logger: Logger, pictures: Mapping[str, UInt8[np.ndarray, "H W 3"]], step: int) -> None:
    for name, picture in pictures.items():
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, picture, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(name, [picture], step=step)


def _log_histogram(logger: Logger, name: str, values: Tensor, step: int) -> None:
    flat = values.detach().float().flatten().cpu().numpy()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_histogram(name, flat, step)
    elif isinstance(logger, WandbLogger):
        from wandb import Histogram

        logger.log_metrics({name: Histogram(flat)}, step)  # type: ignore[arg-type,dict-item]
