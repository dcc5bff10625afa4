"""Inputs of a training that a checkpoint does not contain: surfaces of the medium and cameras of the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.files.cache import file_hash
from nerfro.registry.registration import plugin_of
from nerfro.training.settings import first_difference, flat

# Entry of a checkpoint.
INPUTS = "nerfro_inputs"
_OF_CAMERAS = ("camera_to_world", "fx", "fy", "cx", "cy")
# Differences below this fraction of the largest number are rounding errors of another machine.
_TOLERANCE = 1e-5


def inputs_of(config: DictConfig, cameras: Cameras | None) -> dict[str, Any]:
    """Return a description of the inputs of a training, for its checkpoints.

    Args:
        config: configuration of the run, see `TrainConfig`.
        cameras: cameras of the training views; None if they are unknown.
    """
    described: dict[str, Any] = {"files": file_hashes(config)}
    return described if cameras is None else described | {"cameras": _tensors(cameras)}


def file_hashes(config: DictConfig) -> dict[str, str]:
    """Return a hash of each file that a setting of the medium names, by the name of the setting.

    There is none if rays are straight, because such a training does not use the medium.
    """
    if not plugin_of(config.sampler.path).cls.needs_medium:  # type: ignore[attr-defined]
        return {}
    hashes = {}
    for name, value in flat(config.medium, "medium").items():
        places = value if isinstance(value, list) else [value]
        for number, place in enumerate(places):
            with suppress(OSError, NerfroError):  # other texts than paths
                if isinstance(place, str) and resolve_path(place).is_file():
                    hashes[f"{name}[{number}]" if isinstance(value, list) else name] = file_hash(resolve_path(place))
    return hashes


def changed_file(checkpoint: Mapping[str, Any], config: DictConfig) -> str | None:
    """Return the setting of the medium whose file has changed since a checkpoint was written; None if none has."""
    inputs = checkpoint.get(INPUTS)
    recorded = inputs.get("files") if isinstance(inputs, Mapping) else None
    if not isinstance(recorded, Mapping):
        return None
    return first_difference({str(name): str(value) for name, value in recorded.items()}, file_hashes(config))


def require_same_inputs(checkpoint: Mapping[str, Any], path: Path, config: DictConfig, cameras: Cameras) -> None:
    """Refuse to resume a training whose surface files or cameras have changed.

    Args:
        checkpoint: content of the checkpoint.
        path: file of the checkpoint.
        config: configuration of the run.
        cameras: cameras of the training views.

    Raises:
        NerfroError: an input has changed.
    """
    advice = "restore the earlier data, or start without ckpt_path"
    name = changed_file(checkpoint, config)
    if name is not None:
        raise NerfroError(f"{path} was trained with another content of the file {name}; {advice}")
    inputs = checkpoint.get(INPUTS)
    recorded = inputs.get("cameras") if isinstance(inputs, Mapping) else None
    if isinstance(recorded, Mapping) and not _equal(recorded, _tensors(cameras)):
        raise NerfroError(f"{path} was trained on other photographs or cameras than {config.data.root} has; {advice}")


def _tensors(cameras: Cameras) -> dict[str, torch.Tensor]:
    tensors = {name: getattr(cameras, name).cpu() for name in _OF_CAMERAS}
    lens = cameras.distortion
    return tensors | {"distortion": torch.zeros(len(cameras), 9) if lens is None else lens.cpu()}


def _equal(recorded: Mapping[str, Any], present: Mapping[str, torch.Tensor]) -> bool:
    return recorded.keys() == present.keys() and all(
        torch.is_tensor(old)
        and old.shape == new.shape
        and bool(((old.double() - new).abs() <= _TOLERANCE * new.abs().max().clamp(min=_TOLERANCE)).all())
        for old, new in ((recorded[name], present[name]) for name in present)
    )
