"""Configurations of runs from this machine or other machines."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.errors import NerfroError
from nerfro.files.reading import read_text
from nerfro.trust import require_bounded_yaml

# Former places of modules, in the configurations of earlier runs.
_MOVED = {
    "nerfro.camera.refined.": "nerfro_plugins.refined_cameras.refined.",
    "nerfro.training.phases.cameras.": "nerfro_plugins.refined_cameras.phase.",
}
# Removed settings of earlier runs, with the values that had no effect.
_REMOVED: dict[str, Any] = {"evaluation.refine_steps": 0, "batches.jitter": False}


def foreign_config(text: str, origin: Path) -> DictConfig:
    """Read the configuration of a run, which nerfro.train writes as plain values.

    Interpolations are refused: `${oc.env:...}` would copy the environment of this machine into a shared page.
    """
    for former, present in _MOVED.items():
        text = text.replace(former, present)
    require_bounded_yaml(text, origin)
    try:
        config = OmegaConf.create(text)
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, AssertionError) as error:
        reason = " ".join(str(error).split())
        raise NerfroError(f"{origin} is not the configuration of a run ({reason}); leave the run out") from error
    if not isinstance(config, DictConfig):
        raise NerfroError(f"{origin} is not the configuration of a run; leave the run out")
    interpolation = re.search(r".*\$\{.*", OmegaConf.to_yaml(config))
    if interpolation:
        raise NerfroError(f"{origin} contains an interpolation ({interpolation[0].strip()}); write the value instead")
    for name, value in _REMOVED.items():
        node, _, key = name.rpartition(".")
        if OmegaConf.select(config, name) == value:
            del OmegaConf.select(config, node)[key]
    return config


def read_foreign_config(path: Path) -> DictConfig:
    """Read the configuration of a run from a file; see `foreign_config`."""
    return foreign_config(read_text(path, "repair it, or leave the run out"), path)
