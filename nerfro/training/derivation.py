"""Settings that a run derives from its data."""

from __future__ import annotations

import copy
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nerfro.core.light import to_linear
from nerfro.data.base import Views
from nerfro.media.base import Medium
from nerfro.registry.registration import find, plugin_of
from nerfro.training.content import components, content_settings, space_of
from nerfro.training.settings import with_values


def derived(config: DictConfig, medium: Medium, training: Views) -> DictConfig:
    """Return the configuration of a run with the missing settings that its data define.

    Settings of the space come from cameras and object, and each component derives its own settings, see
    `Component.derive` and `PathSampler.settings_for`. The run records the result, so that its model can be built
    without the data.

    Args:
        config: configuration as given, see `TrainConfig`.
        medium: medium of the run.
        training: training views.

    Raises:
        NerfroError: the space of the run is unknown, see `content_settings`.
    """
    config = with_values(config, content_settings(config, medium, training.cameras))
    space = space_of(config.content)
    values: dict[str, Any] = {}
    for name, component in components(config):
        if OmegaConf.select(config, name) is not None:
            settings = component.derive(config, training, space)
            values |= {f"{name}.{setting}": value for setting, value in settings.items()}
    path_sampler = plugin_of(config.sampler.path)
    for setting, value in path_sampler.cls.settings_for(medium).items():  # type: ignore[attr-defined]
        if setting in path_sampler.hints:  # a derived class may have a constructor of its own
            values[f"sampler.path.{setting}"] = value
    missing = {name: value for name, value in values.items() if OmegaConf.select(config, name) is None}
    return _with_starts(_with_backdrop(with_values(config, missing)))


def _with_starts(config: DictConfig) -> DictConfig:
    """Take the first step of an optimizer group without one from the component that its pattern begins with."""
    config = copy.deepcopy(config)
    for name, component in components(config):
        for pattern, group in config.optimizer.groups.items():
            if group.get("start") is None and pattern.startswith(f"{name}."):
                OmegaConf.update(group, "start", component.learns_from(config), force_add=True)
    return config


def describe_backdrop(config: DictConfig) -> str:
    """Describe the backdrop in one line; the result is empty without a backdrop."""
    colour = OmegaConf.select(config, "loss.backdrop.colour")
    if colour is None:
        return ""
    levels = ", ".join(f"{255 * value:.0f}" for value in colour)
    return f"The photographs have a plain backdrop ({levels}), used as background; loss.backdrop.weight=0 learns one.\n"


def _with_backdrop(config: DictConfig) -> DictConfig:
    """Take the colour of a plain backdrop as the background."""
    loss: Any = config.loss.get("backdrop")
    if not loss or not loss.get("weight", 1) or loss.get("colour") is None:
        return config
    colour = torch.tensor(list(loss.colour))
    radiance = colour if config.model.get("colour") == "srgb" else to_linear(colour)
    constant = {"_target_": find("background", "constant").target, "rgb": radiance.tolist()}
    return with_values(config, {"background": constant})
