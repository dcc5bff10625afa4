"""Bodies of a medium by name, as configurations describe them."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.geometry.mesh import local_origin, origin_of_file
from nerfro.media.material import Abbe, Material, find_material
from nerfro.media.surface import make_surface
from nerfro.registry.allowed import NotNegative, Positive, validate

_LEARNED = ("ior", "absorption")


@dataclass
class BodySettings:
    """Settings of a body, `bodies.NAME`.

    Attributes:
        mesh: closed triangle mesh, world units; by default `medium.mesh`.
        surface: name and settings of another surface (`python -m nerfro.plugins surface`), in place of a mesh.
        ior: refractive index, of the d line if the body disperses light.
        material: material of the catalogue (`python -m nerfro.plugins material`), with its dispersion.
        abbe: Abbe number; without one, the index of a body with `ior` is the same for all colours.
        absorption: coefficients of red, green and blue per world unit, or one for all.
        priority: where bodies overlap, the one with the highest priority decides; of equal ones the last.
        learn: quantities that are learned in training: `ior`, `absorption`; an empty list for none. By default those of
            `medium.learn_ior` and `medium.learn_absorption`.
    """

    mesh: str | None = None
    surface: Any = None
    ior: Positive | None = None
    material: str | None = None
    abbe: Positive | None = None
    absorption: list[NotNegative] = dataclasses.field(default_factory=list)
    priority: int = 0
    learn: list[str] | None = None


@dataclass(frozen=True)
class Body:
    """A body.

    Attributes:
        surface: name and settings of the surface, see `media.surface.make_surface`.
    """

    name: str
    surface: Mapping[str, Any]
    material: Material


def read_bodies(bodies: Any, mesh: str | None, learn: Sequence[str] = ()) -> list[Body]:
    """Read the bodies of a configuration in the order of `ordered_settings`.

    Args:
        bodies: settings of each body by name, see `BodySettings`.
        mesh: mesh of bodies without one.
        learn: learned quantities of bodies without `learn`.

    Raises:
        NerfroError: a setting is unknown, missing or not allowed.
    """
    ordered = ordered_settings(bodies)
    return [Body(name, _surface(name, given, mesh), _material(name, given, learn)) for name, given in ordered]


def ordered_settings(bodies: Any) -> list[tuple[str, BodySettings]]:
    """Read names and settings of bodies, in ascending order of their priorities.

    The last body at a point decides there. The order therefore expresses priorities (Schmidt and Budge 2002, "Simple
    Nested Dielectrics in Ray Traced Images").

    Raises:
        NerfroError: a setting is unknown or not allowed.
    """
    if not isinstance(bodies, Mapping):
        raise NerfroError(f"bodies={bodies} is not a mapping; write bodies={{NAME: {{mesh: FILE, ior: 1.5}}}}")
    settings = {str(name): _settings(str(name), given) for name, given in bodies.items()}
    if not settings:
        raise NerfroError("bodies={} has no body; write bodies={NAME: {mesh: FILE, ior: 1.5}}")
    return sorted(settings.items(), key=lambda item: item[1].priority)


def surfaces_of(medium: Any) -> list[Mapping[str, Any]]:
    """Return the surface of each body in the configuration of a medium."""
    if not isinstance(medium, Mapping):
        return []
    bodies, mesh = medium.get("bodies"), medium.get("mesh")
    if bodies is not None:
        return [body.surface for body in read_bodies(bodies, mesh)]
    return [] if mesh is None else [mesh_surface(mesh)]


def origin_of(medium: Any) -> Float[np.ndarray, "3"]:
    """Return the origin of positions, from the configuration of a medium; see `Medium.origin`."""
    surfaces = surfaces_of(medium)
    if not surfaces:
        return np.zeros(3)
    if surfaces[0].get("name") == "mesh" and "file" in surfaces[0]:
        return origin_of_file(resolve_path(surfaces[0]["file"]))
    return local_origin(make_surface(surfaces[0]).bounds)


def mesh_surface(file: str) -> dict[str, Any]:
    """Return the settings of a mesh surface."""
    return {"name": "mesh", "file": str(file)}


def _settings(name: str, given: Any) -> BodySettings:
    where = f"bodies.{name}"
    if not isinstance(given, Mapping):
        raise NerfroError(f"{where}={given} is not a set of settings; write {where}={{mesh: FILE, ior: 1.5}}")
    settings = validate(BodySettings, given, f"{where}.")
    if len(settings.absorption) not in (0, 1, 3):
        raise NerfroError(f"{where}.absorption={settings.absorption} is not allowed; give red, green and blue, or one")
    unknown = [quantity for quantity in settings.learn or [] if quantity not in _LEARNED]
    if unknown:
        raise NerfroError(f"{where}.learn={settings.learn} is not allowed; choose {' and '.join(_LEARNED)}")
    return settings


def _surface(name: str, given: BodySettings, mesh: str | None) -> Mapping[str, Any]:
    file = given.mesh or mesh
    if given.surface is None:
        if file is None:
            raise NerfroError(f"bodies.{name} needs a mesh; add bodies.{name}.mesh=FILE")
        return mesh_surface(file)
    if given.mesh is not None or not isinstance(given.surface, Mapping):
        raise NerfroError(f"bodies.{name} needs one of mesh and surface; write surface: {{name: ball, radius: 1}}")
    return given.surface


def _material(name: str, given: BodySettings, learn: Sequence[str]) -> Material:
    if (given.ior is None) == (given.material is None):
        raise NerfroError(f"bodies.{name} needs one of ior and material; write ior: 1.5, or material: water")
    learn = learn if given.learn is None else given.learn
    absorption = given.absorption * 3 if len(given.absorption) == 1 else given.absorption or [0.0] * 3
    if given.material is None:
        dispersion = None if given.abbe is None else Abbe(given.abbe)
        return Material(typing.cast(float, given.ior), absorption, dispersion, learn)
    if given.abbe is not None:
        raise NerfroError(
            f"bodies.{name}.abbe={given.abbe} contradicts its material, which has a dispersion; remove it"
        )
    formula = find_material(given.material)
    return Material(formula.ior, absorption, formula, learn)
