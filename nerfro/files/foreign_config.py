"""Configurations of runs from this machine or other machines."""

from __future__ import annotations

import re
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.core.errors import NerfroError
from nerfro.core.trust import require_bounded_yaml
from nerfro.files.reading import read_text


def foreign_config(text: str, origin: Path) -> DictConfig:
    """Read the configuration of a run, which nerfro.train writes as plain values.

    Interpolations are refused: `${oc.env:...}` would copy the environment of this machine into a shared page.
    """
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
    return config


def read_foreign_config(path: Path) -> DictConfig:
    """Read the configuration of a run from a file; see `foreign_config`."""
    return foreign_config(read_text(path, "repair it, or leave the run out"), path)
