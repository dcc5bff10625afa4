"""Old names of settings and options, which work for one release with a warning."""

from __future__ import annotations

import re
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import PLUGINS_PACKAGE

# Former and present places of classes; configurations of earlier releases name the former ones.
MOVED_CLASSES = (
    {
        f"nerfro.data.{module}.{name}": f"{PLUGINS_PACKAGE}.data_formats.{module}.{name}"
        for module, name in (
            ("idr", "IdrData"),
            ("llff", "LlffData"),
            ("nerfstudio", "NerfstudioData"),
            ("colmap", "ColmapData"),
            ("refref", "RefRefData"),
        )
    }
    | {
        f"nerfro.samplers.{module}.{name}": f"nerfro.samplers.{group}.{module}.{name}"
        for group, module, name in (
            ("paths", "snell", "Snell"),
            ("paths", "straight", "Straight"),
            ("points", "density_grid", "DensityGridSampler"),
            ("points", "stratified", "Stratified"),
        )
    }
    | {
        f"{package}.{module}.{name}": f"{PLUGINS_PACKAGE}.paper.{module}.{name}"
        for module, name, packages in (
            ("eikonal", "Eikonal", ("nerfro.samplers", "nerfro.samplers.paths")),
            ("hierarchical", "Hierarchical", ("nerfro.samplers", "nerfro.samplers.points")),
            ("mip_nerf", "MipNerfField", ("nerfro.fields", PLUGINS_PACKAGE)),
            ("mip_nerf", "MipNerfModel", ("nerfro.models", PLUGINS_PACKAGE)),
            ("nerf", "NerfField", ("nerfro.fields",)),
            ("skybox", "Skybox", ("nerfro.boundaries",)),
            ("voxel_grid", "VoxelGrid", ("nerfro.media",)),
        )
        for package in packages
    }
    | {
        "nerfro.camera.refined.RefinedCamera": f"{PLUGINS_PACKAGE}.refined_cameras.refined.RefinedCamera",
        "nerfro.training.phases.background.Background": "nerfro.training.phases.background.BackgroundSteps",
        "nerfro.training.phases.cameras.CameraSteps": f"{PLUGINS_PACKAGE}.refined_cameras.phase.CameraSteps",
        "nerfro.data.opencv.OpenCVData": "nerfro.data.blender.OpenCVData",
        "nerfro.losses.boundary.BoundaryRegulariser": "nerfro.losses.boundary.BoundaryRegularizer",
        "nerfro.losses.distortion.Distortion": f"{PLUGINS_PACKAGE}.distortion.Distortion",
        "nerfro.media.vessel.SdfVessel": f"{PLUGINS_PACKAGE}.vessels.vessel.SdfVessel",
        "nerfro.losses.smoothness.Smoothness": f"{PLUGINS_PACKAGE}.paper.smoothness.Smoothness",
    }
)

# Fields whose positions were always in world units before the setting `unit` existed.
_FIELDS_IN_WORLD_UNITS = frozenset(
    f"{PLUGINS_PACKAGE}.paper.{module}" for module in ("nerf.NerfField", "mip_nerf.MipNerfField")
)

# Old spellings of configuration keys and of options, which work for one release with a warning. Add one line for each
# name that you change; command lines, YAML files of users, run folders and checkpoints then follow. Three forms:
#   "batches.hold_back": "batches.num_validation_views"   a setting or a node with all settings below it
#   "loss=nearby": "near_camera"                          an option of a group (`experiment=NAME` is one, too)
#   "medium.learn_surface": None                          a removed setting: refused on the command line and in
#                                                         YAML files, dropped from the configurations of old runs
#   "medium[SdfGrid].smoothing_size": None                the same in old runs for one class, where others keep it
RENAMED: dict[str, str | None] = {
    "camera.hold_world": "camera.fix_gauge",
    "loss=nearby": "near_camera",
    "loss.nearby": "loss.near_camera",
    "batches.hold_back": "batches.num_validation_views",
    "batches.object": "batches.object_fraction",
    "camera.start": "phase.cameras.start",
    "camera.every": "phase.cameras.every",
    "camera.num_pixels": "phase.cameras.num_pixels",
    "optimizer.boundary_first": "phase.background.steps",
    "optimizer.boundary_steps": "phase.background.steps",
    "optimizer.tint_learning_rate": "optimizer.groups[bodies.*.material.absorption].learning_rate",
    "optimizer.absorption_learning_rate": "optimizer.groups[bodies.*.material.absorption].learning_rate",
    "optimizer.boundary_learning_rate": "optimizer.groups[background.*].learning_rate",
    "optimizer.boundary_start": "optimizer.groups[background.*].start",
    "optimizer.exposure_learning_rate": "optimizer.groups[cameras.exposure].learning_rate",
    "optimizer.medium_learning_rate": "optimizer.groups[bodies.*.material.ior].learning_rate",
    "optimizer.medium_start": "optimizer.groups[bodies.*.material.ior].start",
    "medium.learn_surface": None,
    "optimizer.surface_learning_rate": None,
    "optimizer.surface_start": None,
    "search": None,
    "labels": None,  # of render
    "protocol": None,  # of evaluate
    "lpips_backbone": None,
    "lpips_vgg_backbone": None,
    "evaluation.lpips_backbone": None,
    "evaluation.lpips_vgg_backbone": None,
    "batches.jitter": None,
    "evaluation.refine_steps": None,
    "phase.background.num_pixels": None,
    "phase.background.learn": None,
    "batches.supersample": "batches.subdivision.side",
    "batches.divergence": "batches.subdivision.divergence",
    "batches.contrast": "batches.subdivision.contrast",
    "batches.contrast_start": "batches.subdivision.contrast_start",
    "evaluation.supersample": "evaluation.subdivision.side",
    "evaluation.divergence": "evaluation.subdivision.divergence",
    "evaluation.contrast": "evaluation.subdivision.contrast",
    "supersample": "subdivision.side",  # of evaluate and render
    "divergence": "subdivision.divergence",
    "contrast": "subdivision.contrast",
    "model.scene_share": "model.scene_fraction",
    "model.index_share": "model.index_fraction",
    "sampler.points.every": "sampler.points.update_every",
    "sampler.points.looks": "sampler.points.update_fraction",
    "sampler.points.trust": "sampler.points.max_bin_alpha",
    "sampler.points.num_shown": "sampler.points.num_samples_evaluation",
    "sampler.points.blur": None,
    "sampler.points.padding": None,
    "sampler.points.union": None,
    "boundary.direction_degree": None,
    "content.box_file": None,
    "field.base_resolution": None,
    "field.direction_degree": None,
    "field.normalise": None,
    "loss.boundary.threshold": None,
    "loss.total_variation.num_directions": None,
    "medium.crease_degrees": None,
    "medium.grid": None,
    "medium.half_width": None,
    "medium.subsamples": None,
    "medium[SdfGrid].smoothing_sigma": None,
    "medium[SdfGrid].smoothing_size": None,
}
# Short names of settings, on the command line and in YAML files.
SHORT_NAMES = {"bodies": "medium.bodies"}


def renamed_override(override: str) -> str:
    """Replace old names in a command-line override, with a warning for each.

    Raises:
        NerfroError: the setting is gone, or the override cannot be written with the new name.
    """
    prefix, key, equals, value = _split(override)
    group, at, package = key.partition("@")
    value = re.sub(r"\w+", lambda name: _renamed_option(group, name[0]), value)
    renamed = _renamed_key(package if at else key)
    if renamed is None:
        raise NerfroError(_gone(key))
    of_group = re.fullmatch(r"optimizer\.groups\[(.+)\]\.(\w+)", renamed)
    if of_group is not None:
        pattern, name = of_group.groups()
        if prefix == "~" or not re.fullmatch(r"[^][(){}]+", value):
            raise NerfroError(f"{override}: write 'optimizer.groups={{{pattern}: {{{name}: VALUE}}}}' instead")
        renamed, value = "optimizer.groups", ",".join(f"{{{pattern}: {{{name}: {each}}}}}" for each in value.split(","))
    if renamed == "optimizer.groups" and equals:
        # Hydra reads names with dots only inside of a mapping and without quotes, and adds them only with a plus sign.
        prefix, value = prefix or "+", value.replace('"', "")
    return f"{prefix}{group + at if at else ''}{renamed}{equals}{value}"


def renamed_config(config: DictConfig, origin: Path) -> DictConfig:
    """Replace old names in the configuration of an old run, with one warning, and drop removed settings."""
    found = [f"{old} is called {new}" for old, new in RENAMED.items() if _move(config, old, new) and new]
    _rename_classes(config)
    field = OmegaConf.select(config, "field")
    if isinstance(field, DictConfig) and str(field.get("_target_")) in _FIELDS_IN_WORLD_UNITS:
        field.setdefault("unit", 1.0)
    if found:
        warn(f"{origin} has old names of settings, which can be read for one more release: {', '.join(found)}")
    return config


def _rename_classes(config: DictConfig) -> None:
    """Replace former places of classes in all nodes of a configuration."""
    for _, node in config.items_ex(resolve=False):
        if not isinstance(node, DictConfig) or node._is_none() or node._is_missing() or node._is_interpolation():
            continue
        if str(node.get("_target_")) in MOVED_CLASSES:
            node._target_ = MOVED_CLASSES[str(node._target_)]
        _rename_classes(node)


def rename_in_file(config: DictConfig, package: str, file: str) -> None:
    """Replace old and short names in the content of a YAML file of a user, with a warning for each old name.

    Args:
        config: content of the file.
        package: place of the content in the configuration, such as `optimizer`; `_global_` for the root.
        file: name of the file for messages, without extension.

    Raises:
        NerfroError: the file has a removed setting.
    """
    inside = "" if package == "_global_" else f"{package}."
    for old, new in RENAMED.items():
        is_here = old.startswith(inside) and (new is None or new.startswith(inside))
        if is_here and _move(config, old.removeprefix(inside), new and new.removeprefix(inside)):
            if new is None:
                raise NerfroError(f"{file}.yaml: {_gone(old)}")
            warn(f"{file}.yaml: {_since(old, new)}")
    for short, full in SHORT_NAMES.items():
        if package in ("", "_global_"):
            _move(config, short, full)


def is_old_name(argument: str) -> bool:
    """Test whether a command-line override names an old setting or option."""
    _, key, _, value = _split(argument)
    group, _, package = key.partition("@")
    is_old_option = any(f"{group}={name}" in RENAMED for name in re.findall(r"\w+", value))
    return is_old_option or _entry(package or key) is not None


def renamed_default(group: str, entry: object) -> object:
    """Replace old names in one entry of a defaults list."""
    if isinstance(entry, str):
        return _renamed_option(group, entry)
    if not isinstance(entry, DictConfig):
        return entry
    ((key, option),) = entry.items()
    *_, place = str(key).split()  # after `override` and `optional`
    name, at, package = place.removeprefix("/").partition("@")
    new_place = f"{place[: len(place) - len(package)]}{_renamed_key(package)}" if at else place
    new_option = _renamed_option(name, option) if isinstance(option, str) else option
    return {f"{str(key).removesuffix(place)}{new_place}": new_option}


def _renamed_option(group: str, name: str) -> str:
    new = RENAMED.get(f"{group}={name}")
    if new is None:
        return name
    warn(_since(f"{group}={name}", f"{group}={new}"))
    return new


def _renamed_key(key: str) -> str | None:
    old = _entry(key)
    if old is None:
        return key
    new = RENAMED[old]
    if new is not None:
        warn(_since(old, new))
    return new and new + key.removeprefix(old)


def _entry(key: str) -> str | None:
    """Return the old name that a key has, or that is the name of a node with the key; None for current names."""
    return next((old for old in RENAMED if f"{key}.".startswith(f"{old}.")), None)


def _split(override: str) -> tuple[str, ...]:
    """Split a command-line override into prefix, key, equals sign and value."""
    parts = re.fullmatch(r"(~|\+*)([^=]*)(=?)(.*)", full_key(override), re.DOTALL)
    return cast(re.Match, parts).groups()


def _move(config: DictConfig, old: str, new: str | None) -> bool:
    """Move a node of a configuration to its new place, or drop it; returns whether the node exists."""
    parent, _, name = old.rpartition(".")
    parent, _, owner = parent.rstrip("]").partition("[")
    node = OmegaConf.select(config, parent) if parent else config
    if not isinstance(node, DictConfig) or name not in node or not str(node.get("_target_", "")).endswith(owner):
        return False
    value = node._get_node(name)
    del node[name]
    if new is not None:
        OmegaConf.update(config, new, value, force_add=True)
    return True


def full_key(override: str) -> str:
    """Replace the short name of a setting by the full one."""
    return re.sub(r"^([+~]*)(\w+)(?=[.=])", lambda key: key[1] + SHORT_NAMES.get(key[2], key[2]), override)


def _since(old: str, new: str) -> str:
    return f"{old} is called {new} since this release; the old name works until the next one"


def _gone(old: str) -> str:
    return f"{old} was removed in this release; leave it out (CHANGELOG.md says what to use instead)"
