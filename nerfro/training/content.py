"""Space of a run: the box of the object, all of space around the point that the cameras face, or without bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.data.component import Component
from nerfro.geometry.mesh import local_origin, num_decimals
from nerfro.geometry.space import Box, Contracted, Space, Unbounded
from nerfro.media.base import Medium
from nerfro.media.body_settings import surfaces_of
from nerfro.media.surfaces import make_surface
from nerfro.registry.allowed import NotNegative, OnlyWith, Positive
from nerfro.registry.registration import find, plugin_of

# Smallest eigenvalue with which the point nearest to all optical axes is determined along an eigenvector.
_PARALLEL = 0.01
_WITH_BALL = OnlyWith("space", ("all",))


@dataclass
class ContentConfig:
    """Space of the field and of the samples on paths.

    Attributes:
        space: `box`: a box, with the background outside of it. `all`: all of space, contracted outside of a
            ball, with the background at infinity. `unbounded`: from the near to the far bounds of the rays,
            without contraction.
        box_min: lower corner of the box, world units, relative to the origin of the medium; the ball is centred
            in the box. None takes the bounds of the object, or for the ball the point that the cameras face.
        box_max: upper corner of the box.
        radius: radius of the ball, world units. None derives this and the next setting from the cameras.
        near: arc length of the first samples, world units.
    """

    space: Literal["box", "all", "unbounded"] = "box"
    box_min: list[float] | None = None
    box_max: list[float] | None = None
    radius: Annotated[Positive | None, _WITH_BALL] = None
    near: Annotated[NotNegative | None, _WITH_BALL] = None


def space_of(content: DictConfig | ContentConfig) -> Space:
    """Make the space of complete settings, see `content_settings`; it has no bounds if the box is unknown."""
    box = None if content.box_min is None or content.box_max is None else (content.box_min, content.box_max)
    if box is None or content.space == "unbounded":
        return Unbounded(box)
    if content.space == "box":
        return Box(box)
    if content.radius is None:
        raise NerfroError("content.space=all needs content.radius, the radius of the ball around the content")
    return Contracted(box, content.radius, content.near or 0.0)


def content_settings(config: DictConfig, medium: Medium, cameras: Cameras) -> dict[str, Any]:
    """Derive the missing settings of the space of a run.

    Args:
        config: configuration of the run, see `TrainConfig`.
        medium: medium of the run, which contains the object.
        cameras: cameras of the training views.

    Returns:
        Values by the full names of the settings.

    Raises:
        NerfroError: one corner is given without the other, a component needs a box that is unknown, or the cameras face
            no common point.
    """
    content = config.content
    if content.space == "all":
        cameras.refuse_turntable("content.space=all makes surroundings a part of the object", "take content.space=box")
    if (content.box_min is None) != (content.box_max is None):
        raise NerfroError(
            "content.box_min and content.box_max belong together; give both, or neither for the object's bounds"
        )
    box = _box(config, medium) if content.box_min is None else np.array([list(content.box_min), list(content.box_max)])
    settings: dict[str, Any] = {}
    if content.space == "all":
        box, settings["content.radius"], settings["content.near"] = _ball(content, box, cameras)
    if box is None:
        if content.space == "box":
            _refuse_unknown_box(config)
        return {}
    return {"content.box_min": box[0].tolist(), "content.box_max": box[1].tolist(), **settings}


def components(config: DictConfig) -> Iterator[tuple[str, type[Component]]]:
    """Yield the full name and the class of each `Component` of a run."""
    for name in ("model", "field", "sampler.points", "background"):
        yield name, plugin_of(OmegaConf.select(config, name)).cls
    for name in map(str, config.loss):
        yield f"loss.{name}", find("loss", name).cls


def require_box(config: DictConfig) -> None:
    """Refuse a space that does not fit the components.

    Raises:
        NerfroError: a component needs a box and space is unbounded, or no component covers all of space.
    """
    names = _needing_box(config)
    if config.content.space == "unbounded" and names:
        raise NerfroError(f"content.space=unbounded has no box, which {names[0]} needs; take content.space=box or all")
    if config.content.space == "all" and not {"field", "sampler.points"} & {*names}:
        raise NerfroError(
            "content.space=all needs a field and samples in all of space; add field=volume sampler/points=volume, or "
            "take +experiment=refractive_room"
        )


def describe(config: DictConfig) -> str:
    """Describe the space of a run in one line; the result is empty unless the run covers all of space."""
    content, cells = config.content, config.field.get("finest_resolution")
    if content.space != "all":
        return ""
    middle = ", ".join(f"{0.5 * (low + high):.3g}" for low, high in zip(content.box_min, content.box_max, strict=True))
    finest = "" if cells is None else f"; finest cell {4 * content.radius / cells:.2g}"
    return (
        f"All of space, contracted beyond {content.radius:.3g} around ({middle}); samples from {content.near:.3g} on"
        f"{finest}.\n"
    )


def _ball(
    content: DictConfig, box: Float[np.ndarray, "2 3"] | None, cameras: Cameras
) -> tuple[Float[np.ndarray, "2 3"], float, float]:
    """Derive the ball between the cameras: the box around it, its radius and the arc length of the first samples."""
    poses = cameras.camera_to_world.double().cpu().numpy()
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    # A typical depth from the bounds of the data: the harmonic mean of near and far.
    depth = 2 / (1 / max(cameras.near, 1e-3 * cameras.far) + 1 / cameras.far)
    middle = common_target(centres, forward, depth) if box is None else box.mean(0)
    distances = np.linalg.norm(centres - middle, axis=1)
    # The uncontracted ball reaches half of the median distance from the point that the cameras face to the cameras.
    radius = 0.5 * float(np.median(distances)) if content.radius is None else content.radius
    if not radius > 0:
        raise NerfroError("the cameras lie at the point that they face; give content.radius, in units of the poses")
    radius, near = float(f"{radius:.4g}"), content.near
    if box is None:
        corners = middle + np.array([[-1.0], [1.0]]) * radius
        box = np.array([[float(f"{x:.6g}") for x in corner] for corner in corners])
    # Samples begin at a fraction of the distance of the nearest camera. Few rays cross the space close to a camera, so
    # that density there explains the photograph of that camera alone.
    near = float(f"{0.3 * distances.min():.4g}") if near is None else near
    return box, radius, near


def common_target(
    centres: Float[np.ndarray, "V 3"], forward: Float[np.ndarray, "V 3"], depth: float
) -> Float[np.ndarray, "3"]:
    """Return the point nearest to all optical axes (least squares); for nearly parallel axes, a point at `depth`."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # projects out the axis
    typical = centres.mean(0) + depth * forward.mean(0)
    values, axes = np.linalg.eigh(across.mean(0))
    offset = axes.T @ (across @ (centres - typical)[:, :, None])[:, :, 0].mean(0)
    return typical + axes @ np.where(values > _PARALLEL, offset / np.maximum(values, _PARALLEL), 0.0)


def _box(config: DictConfig, medium: Medium) -> Float[np.ndarray, "2 3"] | None:
    """Return the bounds of the object from the medium or its surfaces; None without both."""
    if not medium.is_vacuum:
        return _rounded(medium.content_box.double().numpy())
    surfaces = surfaces_of(config.medium)
    if surfaces and all(resolve_path(surface.get("file", ".")).exists() for surface in surfaces):
        # Straight rays need no medium, but the baselines get the same bounds as the refractive model.
        bounds = np.stack([make_surface(surface, accept_open_mesh=True).bounds for surface in surfaces])
        return _rounded(np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)]) - local_origin(bounds[0]))
    return None


def _rounded(box: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Round a box to at least seven significant digits of its longest side, and to six decimals."""
    size = float((box[1] - box[0]).max())
    return box.round(max(6, num_decimals(size, 7)) if 0 < size < math.inf else 6)


def _refuse_unknown_box(config: DictConfig) -> None:
    """Refuse components that need the box of the object, which is unknown."""
    for name in _needing_box(config):
        mesh = f", and medium.mesh={config.medium.mesh} does not exist" if "mesh" in config.medium else ""
        raise NerfroError(
            f"{name} needs the box of the object, and no medium defines it{mesh}; for an ordinary photo set take "
            "+experiment=straight, which needs no box, or give content.box_min=[X,Y,Z] content.box_max=[X,Y,Z] "
            "in world units"
        )


def _needing_box(config: DictConfig) -> list[str]:
    """Return the full names of the components that need a space with a box."""
    return [name for name, component in components(config) if component.needs_box]
