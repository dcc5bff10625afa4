"""The scene file `scene.json`: data set, bodies and surroundings of a capture, with their provenance."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from nerfro.cli.overrides import as_overrides, is_given, is_scene_file
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import EMBEDDED_PREFIX, user_path
from nerfro.core.provenance import AlgorithmSettings, command_of_process, versions
from nerfro.files.atomic import write_atomically
from nerfro.files.reading import read_json
from nerfro.media.body_settings import SHADING, BodySettings, expanded
from nerfro.registry.allowed import Count, validate

SCENE = "scene.json"
_ADVICE = "see docs/reference/file_formats.md, or run nerfro.preprocess again"


@dataclass
class Provenance:
    """Origin of a scene file.

    Attributes:
        command: command line of the writer.
        versions: versions of packages.
        algorithms: settings of the algorithms that the command has used (see `provenance.AlgorithmSettings`).
        standard_error: standard error of the estimated index of each body, null for few views; empty for given indices.
        doubts: reasons for doubt about the indices; empty for reliable indices.
        unsupported: names of bodies that do not explain the pixels of the object better than straight rays, the
            smallest error first.
        absorbed: share of red, green and blue light that the object absorbs along the mean path; empty if unknown.
        reflects: whether partial reflection is seen; None if unknown.
    """

    command: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    algorithms: list[str] = field(default_factory=list)
    standard_error: list[float | None] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    unsupported: list[str] = field(default_factory=list)
    absorbed: list[float] = field(default_factory=list)
    reflects: bool | None = None


@dataclass
class SceneFile:
    """Content of `scene.json`; paths in the file are relative to its folder.

    Attributes:
        data: `type` of the data set (an option of the group `data`), and its settings, such as `root`.
        medium: `type` of the medium (an option of the group `medium`), and its settings except those of bodies.
        bodies: bodies by name; where they overlap, the last of the highest priority decides.
        vessel: settings of a fitted vessel, which `medium=vessel` selects instead of the index of the bodies.
        surroundings: whether the surroundings are near or far; None if unknown.
        photograph: width and height of the photographs in pixels; empty if unknown.
        provenance: origin of the file.
    """

    data: dict[str, Any] = field(default_factory=dict)
    medium: dict[str, Any] = field(default_factory=dict)
    bodies: dict[str, BodySettings] = field(default_factory=dict)
    vessel: dict[str, Any] = field(default_factory=dict)
    surroundings: Literal["near", "far"] | None = None
    photograph: list[Count] = field(default_factory=list)
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def short(self) -> dict[str, object] | None:
        """Settings of the medium for at most one body that has only mesh and index; None for other bodies."""
        settings = [_given(body) for body in self.bodies.values()] or [{}]
        return settings[0] if len(settings) == 1 and settings[0].keys() <= {"mesh", "ior"} else None

    @property
    def training_options(self) -> dict[str, object]:
        """Experiment and settings of a training that follow from surroundings, reflection and absorption."""
        absorbs = any(self.provenance.absorbed)
        if self.surroundings == "near":
            return {"experiment": "glass_room"} | ({"medium.learn_absorption": True} if absorbs else {})
        return {"experiment": "glass"} if absorbs or self.provenance.reflects else {}

    def settings(self, *, data_type: str | None = None, medium: str | None = None) -> dict[str, object]:
        """Return the settings of the groups `data` and `medium` by their full names.

        Args:
            data_type: another type of the data set, of which the file describes only the folder.
            medium: another type of the medium.
        """
        data, own = dict(self.data), dict(self.medium)
        if data_type not in (None, data["type"]):
            data = {"type": data_type, "root": data["root"]}
        medium_type = own.pop("type", "object")
        short = self.short
        own |= {"bodies": {name: _given(body) for name, body in self.bodies.items()}} if short is None else short
        if medium == "vessel":
            own |= self.vessel
        settings: dict[str, object] = {"data": data.pop("type")}
        if (medium or medium_type) != "object":  # `object` is the choice of most experiments; others have their own
            settings["medium"] = medium or medium_type
        for group, values in (("data", data), ("medium", own)):
            settings |= {f"{group}.{name}": value for name, value in values.items()}
        return settings

    def added_to(self, overrides: Sequence[str], names: Collection[str], source: str) -> list[str]:
        """Add the settings of the scene to overrides, which have precedence.

        Args:
            overrides: overrides of a command.
            names: names of the settings of the command; other settings of the scene have no effect.
            source: name of the scene, for a warning.
        """
        options = {name: value for name, _, value in (text.partition("=") for text in overrides) if name in names}
        settings = self.settings(data_type=options.get("data"), medium=options.get("medium"))
        is_known = is_given("medium.ior", overrides) or options.get("medium") == "vessel"
        if self.provenance.doubts and "medium" in names and not is_known:
            warn(f"{source}: the photographs do not determine the index ({self.provenance.doubts[0]}); set medium.ior=")
        settings = {n: value for n, value in settings.items() if n.partition(".")[0] in names and n not in options}
        # After the flags of Hydra, and before all other overrides.
        start = next(
            (i for i, text in enumerate(overrides) if "=" in text and not text.startswith("-")), len(overrides)
        )
        return [*overrides[:start], *as_overrides(settings), *overrides[start:]]

    def save(self, path: Path) -> None:
        """Write the file, with the command of this process and the versions of packages."""
        folder = os.path.realpath(path.parent)
        scene = self._with_paths(lambda path: Path(os.path.relpath(os.path.realpath(user_path(path)), folder)))
        installed = {name: version for name, version in versions().items() if version is not None}
        algorithms = list(AlgorithmSettings.used.values())
        origin = replace(self.provenance, command=command_of_process(), versions=installed, algorithms=algorithms)
        document = {name: value for name, value in vars(scene).items() if value not in (None, {}, [])}
        text = json.dumps(document | {"provenance": origin}, default=_given, indent=1)
        # Lists of numbers are on one line.
        write_atomically(path, re.sub(r"\[[^][{}\"]*\]", lambda numbers: re.sub(r"\s+", " ", numbers[0]), text) + "\n")

    def _with_paths(self, convert: Callable[[str], Path]) -> SceneFile:
        """Return a copy with other places of data set and meshes; embedded data stays."""

        def moved(path: str | None) -> str | None:
            return path if path is None or path.startswith(EMBEDDED_PREFIX) else convert(path).as_posix()

        def moved_surface(surface: Any) -> Any:
            if not isinstance(surface, Mapping):
                return surface
            named = {key: moved(value) for key, value in surface.items() if key == "file" and isinstance(value, str)}
            return {key: moved_surface(value) for key, value in surface.items()} | named

        bodies = {
            name: replace(body, mesh=moved(body.mesh), surface=moved_surface(body.surface))
            for name, body in self.bodies.items()
        }
        return replace(self, data=self.data | {"root": moved(str(self.data["root"]))}, bodies=bodies)


def take_bodies(medium: dict[str, Any]) -> dict[str, BodySettings]:
    """Remove the bodies from the settings of a medium, and return them."""
    return expanded({name: medium.pop(name, None) for name in ("mesh", "ior", "bodies", *SHADING)})


def read_scene_file(path: Path) -> SceneFile:
    """Read a scene file.

    Raises:
        NerfroError: the file is damaged, or a name or a value is not allowed.
    """
    document = read_json(path, "give the scene.json of nerfro.preprocess")
    if not isinstance(document, dict):
        raise NerfroError(f"{path} is not a scene file; {_ADVICE}")
    if "${" in json.dumps(document):
        raise NerfroError(f"{path} contains an interpolation (${{...}}); write the value instead")
    try:
        scene = validate(SceneFile, document)
    except NerfroError as error:
        raise NerfroError(f"{path}: {error}; {_ADVICE}") from error
    for group in ("data", "medium", "vessel", "bodies"):
        for name in getattr(scene, group):
            if not re.fullmatch(r"[^\W\d_]\w*", name):
                raise NerfroError(f"{path}: {group} has the key {name!r}; a key has letters, digits and underscores")
    for name, example in (("type", "blender"), ("root", ".")):
        if not isinstance(scene.data.get(name), str):
            raise NerfroError(f"{path} lacks the text data.{name}; write {json.dumps({'data': {name: example}})}")
    folder = Path(os.path.realpath(path.parent))
    if folder == Path(os.path.abspath(path.parent)):  # no link
        folder = path.parent
    return scene._with_paths(lambda path: Path(os.path.normpath(folder / user_path(path))))


def with_scene(arguments: Sequence[str], names: Collection[str]) -> list[str]:
    """Replace `scene=FILE.json` in a command line by the settings in the file; other arguments have precedence.

    Args:
        arguments: command-line overrides.
        names: names of the settings of the command; other settings in the file have no effect.

    Raises:
        NerfroError: several scene files are given, or the file cannot be used.
    """
    files = [text for text in arguments if is_scene_file(text)]
    if not files:
        return list(arguments)
    if len(files) > 1:
        raise NerfroError(f"{files[0]} and {files[1]} are both given; give one scene file")
    path = user_path(files[0].partition("=")[2].strip("'\""))
    scene = read_scene_file(path)
    return scene.added_to([text for text in arguments if text not in files], names, str(path))


def _given(body: BodySettings | Provenance) -> dict[str, object]:
    """Return the settings with other values than the defaults, for JSON."""
    defaults = dataclasses.asdict(type(body)())
    return {name: value for name, value in dataclasses.asdict(body).items() if value != defaults[name]}
