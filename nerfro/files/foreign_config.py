"""Configurations that another run wrote, on this machine or on somebody else's."""

from __future__ import annotations

import re
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.cli import renamed_config
from nerfro.errors import NerfroError


def foreign_config(text: str, origin: Path) -> DictConfig:
    """Read a run's configuration as the plain values that nerfro.train writes.

    Nothing in it is resolved: `${oc.env:...}` would bring this machine's environment into a page that is shared.
    """
    try:
        config = OmegaConf.create(text)
    except (yaml.YAMLError, OmegaConfBaseException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise NerfroError(f"{origin} is no configuration of a run ({reason}); leave the run out") from error
    if not isinstance(config, DictConfig):
        raise NerfroError(f"{origin} is no configuration of a run; leave the run out")
    asks = re.search(r".*\$\{.*", OmegaConf.to_yaml(config))
    if asks:
        raise NerfroError(f"{origin} asks for a value from elsewhere ({asks[0].strip()}); write the value itself there")
    return renamed_config(config, origin)
