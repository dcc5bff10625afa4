"""Loading of the trained scene of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from nerfro.core.paths import user_path
from nerfro.evaluation.request import find_device
from nerfro.registry.registration import discover
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.config import build_data
from nerfro.training.inputs import recorded_cameras
from nerfro.training.run_folder import LAST_CHECKPOINT, load_run, restore
from nerfro.viewing.trained_scene import TrainedScene


def load(run: str | Path, device: str = "auto", root: str | Path | None = None) -> TrainedScene:
    """Load the trained scene of a run.

    The run folder contains the surface of the object and the training cameras, so the scene can be rendered along a
    path and exported without the data.

    Args:
        run: folder of the run, or one of its checkpoints.
        device: `cpu` or `cuda`; `auto` means the CPU.
        root: folder of the data, if it has moved since training.

    Raises:
        NerfroError: the checkpoint cannot be read, or files of the run are missing.
    """
    discover()
    checkpoint, config = load_run(checkpoint_of(run), root)
    return scene_of(checkpoint, config, find_device(device))


def checkpoint_of(run: str | Path) -> Path:
    """Return the checkpoint of a run: the file itself, or the last checkpoint of a run folder."""
    path = user_path(run)
    return path / LAST_CHECKPOINT if path.is_dir() else path


def scene_of(checkpoint: dict[str, Any], config: DictConfig, device: torch.device) -> TrainedScene:
    """Build the scene of a checkpoint from a configuration, whose data and evaluation may differ from training."""
    renderer, cameras = restore(checkpoint, config).to(device), recorded_cameras(checkpoint)
    subdivision = Subdivision(**config.evaluation.subdivision)
    name = config.name
    if "current_model_state" in checkpoint:  # the latest weights, besides the average
        name = f"{name}, average of weights"
        print("weights: moving average over the steps of the run (weight_averaging)", flush=True)
    return TrainedScene(renderer, build_data(config), subdivision, name, cameras)
