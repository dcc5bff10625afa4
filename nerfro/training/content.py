"""Which space a run covers: the object's box, or all of space around what the cameras look at."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from nerfro.allowed import Count, NotNegative, Positive
from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.files.reading import load_array
from nerfro.geometry.mesh import load_mesh
from nerfro.media.analytic import Vacuum
from nerfro.media.base import Medium
from nerfro.paths import resolve_path
from nerfro.registry import build

# The ball's radius, of the cameras' usual distance from what they look at: what they look at is finest.
_RADIUS_SHARE = 0.5
# Samples begin at this share of the nearest camera's distance. Few rays cross what is close before a camera, so that
# what is learned there explains its photograph and no other.
_NEAR_SHARE = 0.3
# A pixel's detail takes two cells of the finest grid along each side, as a wave takes two samples.
_CELLS_PER_PIXEL = 2
# Cells of the finest grid; memory bounds them above.
_FEWEST_CELLS, _MOST_CELLS = 128, 4096
# Below this share of cameras' directions across it, a place is not told by where optical axes meet.
_PARALLEL = 0.01


@dataclass
class ContentConfig:
    """The space that fields and samplers cover."""

    # `box`: a box outside of which there is nothing but the boundary. `all`: all of space, as it is within a ball
    # and contracted beyond, with the boundary at infinity alone.
    space: str = "box"
    # Corners of the box, or of one around whose middle the ball lies, world units; none takes the bounds of the
    # object, or for the ball where the cameras look.
    box_min: Optional[list[float]] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    box_max: Optional[list[float]] = None  # noqa: UP045
    # .npy of the box's centre and half sides [2, 3] instead, as Eikonal Fields stores it.
    box_file: Optional[str] = None  # noqa: UP045
    # Of the ball, the arc length at which samples begin (world units), and cells of the finest grid along the cube
    # around contracted space; none finds them from the cameras.
    radius: Optional[Positive] = None  # noqa: UP045
    near: Optional[NotNegative] = None  # noqa: UP045
    cells: Optional[Count] = None  # noqa: UP045


def settle_content(config: DictConfig, medium: Medium, cameras: Cameras | None = None) -> None:
    """Fill in what is left open in `config.content`.

    Args:
        config: of a run, see `TrainConfig`.
        medium: of the run, which knows where the object is.
        cameras: of the training views; read from the data where they are needed and not given.

    Raises:
        NerfroError: half a box, an unknown space, or no place that the cameras look at.
    """
    content = config.content
    for option in dataclasses.fields(ContentConfig):  # runs from before it was there lack it
        if option.name not in content:
            content[option.name] = option.default
    if content.space not in ("box", "all"):
        raise NerfroError(f"content.space={content.space} is not allowed; choose box, all")
    if (content.box_min is None) != (content.box_max is None):
        raise NerfroError("content: give both box_min and box_max, or neither for the bounds of the object")
    if content.box_min is None:
        box = _box(config, medium)
        if box is not None:
            content.box_min, content.box_max = box.tolist()
        elif content.space == "box":
            _require_no_box(config)
    if content.space == "all" and None in (content.box_min, content.radius, content.near, content.cells):
        _settle_ball(content, build(config.data).load("train").cameras if cameras is None else cameras)


def describe(content: DictConfig) -> str:
    """A line on the space that a run covers, for whoever started it; nothing where it is a box."""
    if content.space == "box":
        return ""
    middle = ", ".join(f"{0.5 * (low + high):.3g}" for low, high in zip(content.box_min, content.box_max, strict=True))
    return (
        f"All of space, contracted beyond {content.radius:.3g} around ({middle}); samples from {content.near:.3g} on; "
        f"finest cell {4 * content.radius / content.cells:.2g}.\n"
    )


def _settle_ball(content: DictConfig, cameras: Cameras) -> None:
    """The ball that the cameras stand around, and what its resolution can be."""
    poses = cameras.camera_to_world.double().cpu().numpy()
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    if content.box_min is None:
        middle = looked_at(centres, forward, _depth(cameras))
    else:
        middle = np.mean([list(content.box_min), list(content.box_max)], axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    radius = _RADIUS_SHARE * float(np.median(distances)) if content.radius is None else content.radius
    if not radius > 0:
        raise NerfroError("content: the cameras stand where they look; give content.radius, in units of the poses")
    content.radius = float(f"{radius:.4g}")
    if content.box_min is None:
        corners = middle + np.array([[-1.0], [1.0]]) * radius
        content.box_min, content.box_max = ([float(f"{x:.6g}") for x in corner] for corner in corners)
    if content.near is None:
        content.near = float(f"{_NEAR_SHARE * distances.min():.4g}")
    if content.cells is None:
        pixel = np.median(distances / cameras.fx.double().cpu().numpy())
        content.cells = int(np.clip(math.ceil(_CELLS_PER_PIXEL * 4 * radius / pixel), _FEWEST_CELLS, _MOST_CELLS))


def looked_at(
    centres: Float[np.ndarray, "V 3"], forward: Float[np.ndarray, "V 3"], depth: float
) -> Float[np.ndarray, "3"]:
    """The place nearest to all optical axes (least squares); along axes that are nearly parallel, at a usual depth."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # projects out the axis
    usual = centres.mean(0) + depth * forward.mean(0)
    values, axes = np.linalg.eigh(across.mean(0))
    offset = axes.T @ (across @ (centres - usual)[:, :, None])[:, :, 0].mean(0)
    return usual + axes @ np.where(values > _PARALLEL, offset / np.maximum(values, _PARALLEL), 0.0)


def _depth(cameras: Cameras) -> float:
    """A usual depth where only the data's bounds tell: that in the middle of the inverse distances."""
    return 2 / (1 / max(cameras.near, 1e-3 * cameras.far) + 1 / cameras.far)


def _box(config: DictConfig, medium: Medium) -> Float[np.ndarray, "2 3"] | None:
    """Where the object is, as far as something other than the cameras tells."""
    if config.content.box_file is not None:
        centre, half = _read_box(resolve_path(config.content.box_file))
        return np.stack([centre - half, centre + half])
    if not isinstance(medium, Vacuum):
        return medium.content_box.double().numpy().round(6)
    if "mesh" in config.medium and resolve_path(config.medium.mesh).is_file():
        # Straight rays need no medium, but a baseline is told where the object is, as ours is.
        return load_mesh(resolve_path(config.medium.mesh), accept_open_mesh=True).bounds.round(6)
    return None


def _require_no_box(config: DictConfig) -> None:
    """Refuse parts that stay inside the content's box where nothing says where that is."""
    for name, node in (("field", config.field), ("sampler/points", config.sampler.points)):
        written = OmegaConf.to_container(node, resolve=False)
        if isinstance(written, dict) and "content.box" in str(written.get("box_min")):
            mesh = f", and medium.mesh={config.medium.mesh} does not exist" if "mesh" in config.medium else ""
            raise NerfroError(
                f"{name} stays inside a box, and straight rays know no object to take it from{mesh}; for an ordinary "
                "photo set take +experiment=straight, which needs none, or give content.box_min=[X,Y,Z] "
                "content.box_max=[X,Y,Z] in world units, around what shall be seen sharply"
            )


def _read_box(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half sides of a box, from Eikonal Fields' bounding_box_vals.npy."""
    values = load_array(path)
    if values.shape != (2, 3) or not np.isfinite(values).all() or values[1].min() <= 0:
        raise NerfroError(f"content.box_file={path} must hold a box's centre and positive half sides, 2x3 numbers")
    return values[0], values[1]
