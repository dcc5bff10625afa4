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
from nerfro.geometry.gltf import glass_of_file
from nerfro.geometry.mesh import local_origin, origin_of_file
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.material import Abbe, Learns, Material, find_material, learned_quantities
from nerfro.media.surfaces import CreaseAngle, Shading, make_surface
from nerfro.registry.allowed import NotNegative, Positive, Resolution, require_names, validate
from nerfro.registry.registration import discover, find, register

_LEARNED = ("ior", "absorption")
SHADING = ("shading", "crease_degrees")  # settings of a mesh, of a body or of the medium


@dataclass
class BodySettings:
    """Settings of a body, `bodies.NAME`.

    Attributes:
        mesh: closed triangle mesh, world units; by default `medium.mesh`.
        surface: name and settings of another surface (`python -m nerfro.plugins surface`), in place of a mesh.
        ior: refractive index, of the d line if the body disperses light; by default, with `abbe` and `absorption`, that
            of the material of a glTF file.
        material: material of the catalogue (`python -m nerfro.plugins material`), with its dispersion.
        abbe: Abbe number; without one, the index of a body with `ior` is the same for all colours.
        absorption: coefficients of red, green and blue per world unit, or one for all.
        priority: where bodies overlap, the one with the highest priority decides; of equal ones the last.
        learn: quantities that are learned in training: `ior`, `absorption`; an empty list for none. By default those of
            `medium.learn_ior` and `medium.learn_absorption`.
        shading: whether the triangles of the mesh are samples of a `smooth` surface or `flat`; by default
            `medium.shading`.
        crease_degrees: edges with larger angles between their triangles are sharp; by default `medium.crease_degrees`.
    """

    mesh: str | None = None
    surface: Any = None
    ior: Positive | None = None
    material: str | None = None
    abbe: Positive | None = None
    absorption: list[NotNegative] = dataclasses.field(default_factory=list)
    priority: int = 0
    learn: list[str] | None = None
    shading: Shading | None = None
    crease_degrees: CreaseAngle | None = None


def expanded(medium: Mapping[str, Any]) -> dict[str, BodySettings]:
    """Return the settings of each body of a medium, in ascending order of priority.

    `mesh` and `ior` of the medium are short for one body with the name `object`; with `bodies`, `mesh` is the surface
    of bodies that have none. `shading` and `crease_degrees` of the medium are those of meshes that have neither.

    Raises:
        NerfroError: a setting is unknown or not allowed.
    """
    bodies, mesh = medium.get("bodies"), medium.get("mesh")
    if bodies is None:
        if mesh is None:
            return {}
        return {"object": _with_shading(BodySettings(mesh=str(mesh), ior=medium.get("ior")), medium)}
    if not isinstance(bodies, Mapping):
        raise NerfroError(f"bodies={bodies} is not a mapping; write bodies={{NAME: {{mesh: FILE, ior: 1.5}}}}")
    if not bodies:
        raise NerfroError("bodies={} has no body; write bodies={NAME: {mesh: FILE, ior: 1.5}}")
    settings = {str(name): _settings(str(name), values) for name, values in bodies.items()}
    if mesh is not None:
        own = {name: body for name, body in settings.items() if body.mesh is not None or body.surface is not None}
        settings = {name: dataclasses.replace(body, mesh=str(mesh)) for name, body in settings.items()} | own
    settings = {name: _with_shading(body, medium) for name, body in settings.items()}
    return dict(sorted(settings.items(), key=lambda item: item[1].priority))


def _with_shading(body: BodySettings, medium: Mapping[str, Any]) -> BodySettings:
    if body.mesh is None or body.shading is not None or body.crease_degrees is not None:
        return body
    settings: dict[str, Any] = {name: medium.get(name) for name in SHADING}
    return dataclasses.replace(body, **settings)


def surfaces_of(medium: Any) -> list[Mapping[str, Any]]:
    """Return the settings of the surface of each body in the configuration of a medium."""
    bodies = expanded(medium) if isinstance(medium, Mapping) else {}
    return [surface_settings(name, body) for name, body in bodies.items()]


def origin_of(medium: Any) -> Float[np.ndarray, "3"]:
    """Return the origin of positions, from the configuration of a medium; see `Medium.origin`."""
    surfaces = surfaces_of(medium)
    if not surfaces:
        return np.zeros(3)
    if surfaces[0].get("name") == "mesh" and "file" in surfaces[0]:
        return origin_of_file(resolve_path(surfaces[0]["file"]))
    return local_origin(make_surface(surfaces[0]).bounds)


@register("medium", "sdf_grid")
def make_bodies(
    mesh: str | None = None,
    ior: Positive | None = None,
    resolution: Resolution | None = None,
    box_min: Sequence[float] | None = None,
    box_max: Sequence[float] | None = None,
    shell_voxels: Positive = 0.1,
    accept_open_mesh: bool = False,
    learn_ior: Learns = False,
    learn_absorption: Learns = False,
    cache: bool = True,
    bodies: dict[str, Any] | None = None,
    shading: Shading = "auto",
    crease_degrees: CreaseAngle | None = None,
    max_gigabytes: Positive = 3.0,
) -> Bodies:
    """Make bodies of constant index with closed surfaces, which are sharp for `snell` and thin shells for `eikonal`.

    Each body has its own grid in its own box, so bodies may be nested, apart, or overlap.

    Args:
        mesh: closed triangle mesh of the body, world units, any format trimesh reads; with `bodies`, the mesh of bodies
            that have none.
        ior: refractive index of the body; by default that of the material in a glTF file, or 1.5.
        resolution: vertices along each side of the grid of each body. By default 128, and more for a body with thin
            walls in air, so that most of its walls have five voxels.
        box_min, box_max: corners of all grids, world units; None for the bounds of each surface and a margin of air.
        shell_voxels: half width of the smooth interface that the Eikonal equation sees, voxels.
        accept_open_mesh: accept meshes with holes. Rays along three axes decide by majority whether a point is inside.
        learn_ior: refine the refractive indices of all bodies without a setting `learn` in training.
        learn_absorption: learn the absorption of the same bodies; only for `sampler/path=snell`.
        cache: keep the distances in the cache folder.
        bodies: bodies by name, with the settings mesh or surface, ior or material, abbe, absorption, priority, learn,
            shading and crease_degrees of each (`media.body_settings.BodySettings`); replaces `ior`.
        shading: whether the triangles of meshes are samples of a `smooth` surface or `flat`; `auto` decides for each
            face.
        crease_degrees: edges with larger angles between their triangles are sharp. If it is given, `auto` looks for no
            facets; by default 30.
        max_gigabytes: memory up to which thin walls raise the resolution of a grid; 3 are enough for 360 vertices.
    """
    settings = expanded(
        {"mesh": mesh, "ior": ior, "bodies": bodies, "shading": shading, "crease_degrees": crease_degrees}
    )
    if not settings:
        raise NerfroError("medium=sdf_grid needs mesh; add medium.mesh=..., or bodies={NAME: {mesh: FILE, ior: 1.5}}")
    learn = learned_quantities(learn_ior, learn_absorption)
    grid = GridSettings(resolution, box_min, box_max, shell_voxels, cache, max_gigabytes)
    grid.require_memory(len(settings))  # before the surfaces are read
    members = []
    for name, body in settings.items():
        surface = make_surface(surface_settings(name, body), accept_open_mesh)
        body = _with_material_of_file(body, None if bodies else 1.5)
        members.append(Body(name, surface, make_material(name, body, learn), body.priority))
    return Bodies(members, grid=grid)


def _settings(name: str, values: Any) -> BodySettings:
    where = f"bodies.{name}"
    if not isinstance(values, Mapping):
        raise NerfroError(f"{where}={values} is not a set of settings; write {where}={{mesh: FILE, ior: 1.5}}")
    settings = validate(BodySettings, values, f"{where}.")
    if len(settings.absorption) not in (0, 1, 3):
        raise NerfroError(f"{where}.absorption={settings.absorption} is not allowed; give red, green and blue, or one")
    unknown = [quantity for quantity in settings.learn or [] if quantity not in _LEARNED]
    if unknown:
        raise NerfroError(f"{where}.learn={settings.learn} is not allowed; choose {' and '.join(_LEARNED)}")
    return settings


def surface_settings(name: str, body: BodySettings) -> Mapping[str, Any]:
    """Return name and settings of the surface of a body, for `media.surfaces.make_surface`."""
    if body.surface is None:
        if body.mesh is None:
            raise NerfroError(f"bodies.{name} needs a mesh; add bodies.{name}.mesh=FILE")
        shading = {name: getattr(body, name) for name in SHADING if getattr(body, name) is not None}
        return {"name": "mesh", "file": body.mesh} | shading
    if body.mesh is not None or not isinstance(body.surface, Mapping):
        raise NerfroError(f"bodies.{name} needs one of mesh and surface; write surface: {{name: ball, radius: 1}}")
    if body.shading is not None or body.crease_degrees is not None:
        raise NerfroError(f"shading and crease_degrees of bodies.{name} belong to its surface; write them in surface:")
    if "name" in body.surface:
        discover()
        plugin = find("surface", str(body.surface["name"]))
        require_names(f"bodies.{name}.surface.", ["name", *plugin.hints], body.surface)
    return body.surface


def _with_material_of_file(body: BodySettings, ior: float | None) -> BodySettings:
    """Add index, absorption and Abbe number of the material in a glTF file to a body without index.

    Args:
        body: settings of the body.
        ior: index of a body whose mesh has no refractive material.
    """
    if body.ior is not None or body.material is not None:
        return body
    glass = None if body.mesh is None else glass_of_file(resolve_path(body.mesh))
    if glass is None:
        return dataclasses.replace(body, ior=ior)
    abbe, absorption = body.abbe or glass.abbe, body.absorption or list(glass.absorption)
    return dataclasses.replace(body, ior=glass.ior, abbe=abbe, absorption=absorption)


def make_material(name: str, body: BodySettings, learn: Sequence[str] = ()) -> Material:
    """Make the material of a body.

    Args:
        name: name of the body.
        body: settings of the body.
        learn: learned quantities of a body without `learn`.
    """
    if (body.ior is None) == (body.material is None):
        raise NerfroError(f"bodies.{name} needs one of ior and material; write ior: 1.5, or material: water")
    learn = learn if body.learn is None else body.learn
    absorption = body.absorption * 3 if len(body.absorption) == 1 else body.absorption or [0.0] * 3
    if body.material is None:
        dispersion = None if body.abbe is None else Abbe(body.abbe)
        return Material(typing.cast(float, body.ior), absorption, dispersion, learn)
    if body.abbe is not None:
        raise NerfroError(f"bodies.{name}.abbe={body.abbe} contradicts its material, which has a dispersion; remove it")
    formula = find_material(body.material)
    return Material(formula.ior, absorption, formula, learn)
