"""Space and unit of the fields: the box of the object, or all of space around the common point of the optical axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.geometry.mesh import local_origin, num_decimals
from nerfro.media.analytic import Vacuum
from nerfro.media.base import Medium
from nerfro.media.bodies import surfaces_of
from nerfro.media.surface import make_surface
from nerfro.registry.allowed import Count, NotNegative, OnlyWith, Positive
from nerfro.registry.registration import build

# Radius of the uncontracted ball, as a fraction of the median distance from the cameras to the point they face.
_RADIUS_SHARE = 0.5
# Samples begin at this fraction of the distance of the nearest camera. Few rays cross the space close to a camera, so
# that density there explains the photograph of that camera alone.
_NEAR_SHARE = 0.3
# A detail of one pixel needs two cells of the finest grid along each side (sampling theorem).
_CELLS_PER_PIXEL = 2
# Bounds of the number of cells of the finest grid; memory limits the upper one.
_MIN_CELLS, _MAX_CELLS = 128, 4096
# Distance from near to far in the scenes of NeRF, for whose world unit its encoding of positions is made.
_RANGE_OF_RAYS = 4.0
# Smallest eigenvalue with which the point nearest to all optical axes is determined along an eigenvector.
_PARALLEL = 0.01
_WITH_BALL = OnlyWith("space", ("all",))


@dataclass
class ContentConfig:
    """Space of fields and samplers.

    Attributes:
        space: `box`: a box, with the background outside of it. `all`: all of space, contracted outside of a
            ball, with the background at infinity.
        box_min: lower corner of the box, world units, relative to the origin of the medium; the ball is centred
            in the box. None takes the bounds of the object, or for the ball the point that the cameras face.
        box_max: upper corner of the box.
        radius: radius of the ball, world units. None derives this and the next settings from the cameras.
        near: arc length of the first samples, world units.
        cells: number of cells of the finest grid along the cube around contracted space.
    """

    space: Literal["box", "all"] = "box"
    box_min: list[float] | None = None
    box_max: list[float] | None = None
    radius: Annotated[Positive | None, _WITH_BALL] = None
    near: Annotated[NotNegative | None, _WITH_BALL] = None
    cells: Annotated[Count | None, _WITH_BALL] = None


def derive_content(config: DictConfig, medium: Medium, cameras: Cameras | None = None) -> None:
    """Derive the missing settings of `config.content`.

    Args:
        config: configuration of a run, see `TrainConfig`; it is changed.
        medium: medium of the run, which contains the object.
        cameras: cameras of the training views; None to read them from the data if they are needed.

    Raises:
        NerfroError: one corner is given without the other, or the cameras face no common point.
    """
    content = config.content
    if (content.box_min is None) != (content.box_max is None):
        raise NerfroError(
            "content.box_min and content.box_max belong together; give both, or neither for the object's bounds"
        )
    if content.box_min is None:
        box = _box(config, medium)
        if box is not None:
            content.box_min, content.box_max = box.tolist()
        elif content.space == "box":
            _require_no_box(config)
    if content.space == "all" and None in (content.box_min, content.radius, content.near, content.cells):
        _derive_ball(content, build(config.data).load("train").cameras if cameras is None else cameras)


def derive_unit(config: DictConfig, cameras: Cameras) -> None:
    """Derive the missing unit of a field that encodes positions, `field.unit`.

    Args:
        config: configuration of a run, see `TrainConfig`; it is changed.
        cameras: cameras of the training views.
    """
    if config.field.get("unit", 1) is None:
        config.field.unit = (cameras.far - cameras.near) / _RANGE_OF_RAYS


def require_contraction(config: DictConfig) -> None:
    """Refuse `content.space=all` without a component that covers all of space.

    Raises:
        NerfroError: neither the field nor the point sampler has a radius.
    """
    nodes = (OmegaConf.to_container(node, resolve=False) for node in (config.field, config.sampler.points))
    if config.content.space == "all" and not any(isinstance(node, dict) and node.get("radius") for node in nodes):
        raise NerfroError(
            "content.space=all needs a field and samples in all of space; add field=volume sampler/points=volume, or "
            "take +experiment=refractive_room"
        )


def describe(content: DictConfig) -> str:
    """Describe the space of a run in one line; the result is empty if the space is a box."""
    if content.space == "box":
        return ""
    middle = ", ".join(f"{0.5 * (low + high):.3g}" for low, high in zip(content.box_min, content.box_max, strict=True))
    return (
        f"All of space, contracted beyond {content.radius:.3g} around ({middle}); samples from {content.near:.3g} on; "
        f"finest cell {4 * content.radius / content.cells:.2g}.\n"
    )


def _derive_ball(content: DictConfig, cameras: Cameras) -> None:
    """Derive the ball between the cameras, and the resolution of the cameras in the ball."""
    poses = cameras.camera_to_world.double().cpu().numpy()
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    if content.box_min is None:
        middle = common_target(centres, forward, _depth(cameras))
    else:
        middle = np.mean([list(content.box_min), list(content.box_max)], axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    radius = _RADIUS_SHARE * float(np.median(distances)) if content.radius is None else content.radius
    if not radius > 0:
        raise NerfroError("the cameras lie at the point that they face; give content.radius, in units of the poses")
    content.radius = float(f"{radius:.4g}")
    if content.box_min is None:
        corners = middle + np.array([[-1.0], [1.0]]) * radius
        content.box_min, content.box_max = ([float(f"{x:.6g}") for x in corner] for corner in corners)
    if content.near is None:
        content.near = float(f"{_NEAR_SHARE * distances.min():.4g}")
    if content.cells is None:
        pixel = np.median(distances / cameras.fx.double().cpu().numpy())
        content.cells = int(np.clip(math.ceil(_CELLS_PER_PIXEL * 4 * radius / pixel), _MIN_CELLS, _MAX_CELLS))


def common_target(
    centres: Float[np.ndarray, "V 3"], forward: Float[np.ndarray, "V 3"], depth: float
) -> Float[np.ndarray, "3"]:
    """Return the point nearest to all optical axes (least squares); for nearly parallel axes, a point at `depth`."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # projects out the axis
    typical = centres.mean(0) + depth * forward.mean(0)
    values, axes = np.linalg.eigh(across.mean(0))
    offset = axes.T @ (across @ (centres - typical)[:, :, None])[:, :, 0].mean(0)
    return typical + axes @ np.where(values > _PARALLEL, offset / np.maximum(values, _PARALLEL), 0.0)


def _depth(cameras: Cameras) -> float:
    """Return a typical depth from the bounds of the data: the harmonic mean of near and far."""
    return 2 / (1 / max(cameras.near, 1e-3 * cameras.far) + 1 / cameras.far)


def _box(config: DictConfig, medium: Medium) -> Float[np.ndarray, "2 3"] | None:
    """Return the bounds of the object from the medium or its surfaces; None without both."""
    if not isinstance(medium, Vacuum):
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


def _require_no_box(config: DictConfig) -> None:
    """Refuse components that need the box of the content if the box is unknown."""
    for name, node in (("field", config.field), ("sampler/points", config.sampler.points)):
        written = OmegaConf.to_container(node, resolve=False)
        if isinstance(written, dict) and "content.box" in str(written.get("box_min")):
            mesh = f", and medium.mesh={config.medium.mesh} does not exist" if "mesh" in config.medium else ""
            raise NerfroError(
                f"{name} needs the box of the object, and no medium defines it{mesh}; for an ordinary photo set take "
                "+experiment=straight, which needs no box, or give content.box_min=[X,Y,Z] content.box_max=[X,Y,Z] "
                "in world units"
            )
