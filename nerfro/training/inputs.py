"""Inputs of a training: surfaces of the medium, and photographs with their cameras; a run opens without its data."""

from __future__ import annotations

import math
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

import torch
from omegaconf import DictConfig

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import ASSETS_DIR, EMBEDDED_PREFIX, resolve_path
from nerfro.data.base import Views
from nerfro.files.atomic import atomic_file
from nerfro.files.cache import content_hash, file_hash
from nerfro.files.reading import same_content
from nerfro.registry.registration import plugin_of
from nerfro.training.settings import first_difference, flat, with_values

# Entry of a checkpoint.
INPUTS = "nerfro_inputs"
# Folder of a run with copies of the files that its settings name.
INPUTS_FOLDER = "inputs"
_GROUPS = ("camera", "medium", "sampler", "field", "background", "model")  # whose settings may name files
_OF_CAMERAS = ("camera_to_world", "fx", "fy", "cx", "cy")
# Differences below this fraction of the largest number are rounding errors of another machine.
_TOLERANCE = 1e-5


def inputs_of(config: DictConfig, views: Views | None) -> dict[str, Any]:
    """Return a description of the inputs of a training, for its checkpoints.

    Args:
        config: configuration of the run, see `TrainConfig`.
        views: training views; None if they are unknown.
    """
    described: dict[str, Any] = {"files": file_hashes(config)}
    if views is None:
        return described
    cameras = views.cameras
    bounds = {"near": float(cameras.near), "far": float(cameras.far), "turntable": cameras.turntable}
    image = {"width": cameras.width, "height": cameras.height, **bounds}
    return described | {"cameras": _tensors(cameras), "image": image, "photographs": _hash_of_photographs(views)}


def recorded_cameras(checkpoint: Mapping[str, Any]) -> Cameras | None:
    """Return the cameras of the training views in a checkpoint; None if it has none or they are damaged."""
    tensors, image = (_recorded(checkpoint, name) for name in ("cameras", "image"))
    try:
        values = {name: torch.as_tensor(tensors[name], dtype=torch.float32) for name in (*_OF_CAMERAS, "distortion")}
        num_views = len(values["fx"])
        shapes = {"camera_to_world": (num_views, 3, 4), "distortion": (num_views, 9)}
        sides = int(image["width"]), int(image["height"])
        near, far, turntable = float(image["near"]), float(image["far"]), image["turntable"]
    except (TypeError, KeyError, ValueError, OverflowError, RuntimeError):
        return None
    right = all(
        value.shape == shapes.get(name, (num_views,)) and value.isfinite().all() for name, value in values.items()
    )
    right &= isinstance(turntable, bool | tuple) and num_views > 0
    if not right or min(sides) < 1 or not 0 <= near < far < math.inf:
        return None
    distortion = values.pop("distortion")
    return Cameras(**values, width=sides[0], height=sides[1], near=near, far=far,
                   distortion=distortion if distortion.any() else None,
                   turntable=turntable)  # fmt: skip


def copy_files(folder: Path, config: DictConfig) -> None:
    """Copy the files that settings of a run name, such as the mesh, into its folder, so that it opens without its data.

    Embedded files, and `.gltf` files, which consist of several files, are left out.
    """
    for name, file in _files(config, _GROUPS).items():
        copied = folder / INPUTS_FOLDER / f"{name}{file.suffix}"
        own = not file.is_relative_to(ASSETS_DIR) and file.suffix.lower() not in ("", ".gltf")
        if own and not same_content(file, copied):
            with file.open("rb") as source, atomic_file(copied) as target:
                shutil.copyfileobj(source, target)


def relocated(config: DictConfig, folder: Path, root: str | Path | None = None) -> DictConfig:
    """Return the configuration of a run with the present places of its files.

    Files of the object are those that the run has copied (`copy_files`), otherwise those below the folder of the data.
    Without `root`, a relative `data.root` that does not exist here is searched from the folders around the run.

    Args:
        config: configuration as trained.
        folder: folder of the run.
        root: folder of the data, if it has moved since training.
    """
    trained = str(config.data.root)
    if root is None and not PurePath(trained).is_absolute() and not trained.startswith((EMBEDDED_PREFIX, "~")):
        candidates = (parent / trained for parent in (Path(), *folder.resolve().parents))
        root = next((candidate for candidate in candidates if candidate.is_dir()), None)
    values = {} if root is None else {"data.root": str(root)}
    copies = {file.stem: str(file) for file in (folder / INPUTS_FOLDER).glob("*") if not file.name.startswith(".")}
    for name, location in _texts(config, _GROUPS):
        if name in copies:
            values[name] = copies[name]
        elif (
            root is not None and PurePath(location).is_relative_to(trained) and not trained.startswith(EMBEDDED_PREFIX)
        ):
            values[name] = str(Path(root) / PurePath(location).relative_to(trained))
    return with_values(config, values)


def require_files(checkpoint: Mapping[str, Any], config: DictConfig) -> None:
    """Refuse a run whose surface files are missing."""
    locations = dict(_texts(config, ("medium",)))
    for name in _recorded_files(checkpoint).keys() & locations.keys():
        location = locations[name]
        if not resolve_path(location).is_file():
            raise NerfroError(
                f"{name}={location} of the run does not exist, and the run folder has no copy of it; give root=FOLDER, "
                "the folder of the data, or restore the file"
            )


def _texts(config: DictConfig, groups: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield name and value of each text among the settings of some groups."""
    for group in groups:
        for name, value in flat(config.get(group), group).items():
            items = {f"{name}[{i}]": item for i, item in enumerate(value)} if isinstance(value, list) else {name: value}
            yield from ((item, text) for item, text in items.items() if isinstance(text, str))


def _files(config: DictConfig, groups: Collection[str]) -> dict[str, Path]:
    """Return the existing files that settings of some groups name."""
    files = {}
    for name, location in _texts(config, groups):
        with suppress(OSError, NerfroError):  # other texts than paths
            path = resolve_path(location)
            if path.is_file():
                files[name] = path
    return files


def file_hashes(config: DictConfig) -> dict[str, str]:
    """Return a hash of each file that a setting of the medium names, by the name of the setting.

    There is none if rays are straight, because such a training does not use the medium.
    """
    if not plugin_of(config.sampler.path).cls.needs_medium:  # type: ignore[attr-defined]
        return {}
    return {name: file_hash(file) for name, file in _files(config, ("medium",)).items()}


def changed_file(checkpoint: Mapping[str, Any], config: DictConfig) -> str | None:
    """Return the setting of the medium whose file has changed since a checkpoint was written; None if none has."""
    if not isinstance(_recorded(checkpoint, "files"), Mapping):
        return None
    return first_difference(_recorded_files(checkpoint), file_hashes(config))


def compared_by_content(checkpoint: Mapping[str, Any]) -> set[str]:
    """Return the settings that name files and folders of which a checkpoint records the content."""
    files = {name.partition("[")[0] for name in _recorded_files(checkpoint)}
    return files | ({"data.root"} if isinstance(_recorded(checkpoint, "photographs"), str) else set())


def _recorded(checkpoint: Mapping[str, Any], name: str) -> Any:
    """Return an entry of `inputs_of` in a checkpoint, which may be damaged; None if the checkpoint lacks the entry."""
    inputs = checkpoint.get(INPUTS)
    return inputs.get(name) if isinstance(inputs, Mapping) else None


def _recorded_files(checkpoint: Mapping[str, Any]) -> dict[str, str]:
    files = _recorded(checkpoint, "files")
    return {str(name): str(value) for name, value in files.items()} if isinstance(files, Mapping) else {}


def require_same_inputs(checkpoint: Mapping[str, Any], path: Path, config: DictConfig, views: Views) -> None:
    """Refuse to resume a training whose surface files, photographs or cameras have changed.

    Args:
        checkpoint: content of the checkpoint.
        path: file of the checkpoint.
        config: configuration of the run.
        views: training views.

    Raises:
        NerfroError: an input has changed.
    """
    advice = "restore the earlier data, or start without ckpt_path"
    name = changed_file(checkpoint, config)
    if name is not None:
        raise NerfroError(f"{path} was trained with another content of the file {name}; {advice}")
    cameras, photographs = (_recorded(checkpoint, entry) for entry in ("cameras", "photographs"))
    image = _recorded(checkpoint, "image")
    other_cameras = isinstance(cameras, Mapping) and not _equal(cameras, _tensors(views.cameras))
    other_cameras |= isinstance(image, Mapping) and image.get("turntable", False) != views.cameras.turntable
    if other_cameras or (isinstance(photographs, str) and photographs != _hash_of_photographs(views)):
        raise NerfroError(f"{path} was trained on other photographs or cameras than {config.data.root} has; {advice}")


def _hash_of_photographs(views: Views) -> str | None:
    """Hash names and sizes of the photographs and the content of some; None if the data format has no image files."""
    if not views.frames:
        return None
    files = [frame.image for frame in views.frames]
    contents = [file_hash(files[view]) for view in views.spread(8)]
    return content_hash(*views.names, *(file.stat().st_size for file in files), *contents)


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
