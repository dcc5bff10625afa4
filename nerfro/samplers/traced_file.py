"""What `python -m nerfro.trace` reads and computes: rays of a file, and where their paths leave the medium's box."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import MISSING
from torch import Tensor

from nerfro.allowed import Coordinate, Distance, check
from nerfro.errors import NerfroError
from nerfro.files.reading import load_arrays
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.base import Medium
from nerfro.types import Path, Rays

# Without `far`, paths end this many diagonals of the medium's box beyond it: room for rays that are reflected inside.
_DIAGONALS = 2


@dataclass
class TraceSamplerConfig:
    """The group sampler/; its path option is a registered plugin's configuration."""

    path: Any = MISSING


@dataclass
class TraceConfig:
    """What `python -m nerfro.trace` is asked."""

    # What is traced, and how (options of the groups `medium` and `sampler/path`).
    medium: Any = MISSING
    sampler: TraceSamplerConfig = dataclasses.field(default_factory=TraceSamplerConfig)
    rays: str = MISSING  # .npz with `origins` and `directions` [R, 3], world units and unit directions
    # .npz that is written, with `exit_positions` and `exit_directions` [R, 3], `path_lengths` and `hit` [R]. Where rays
    # split there is a row for each path, and also its `ray` (row in `rays`) and `throughput` [P, 3].
    out: str = MISSING
    near: Distance = 0.0  # arc length at which paths begin
    # Arc length at which paths end, or where they have left the medium's box if that is later; by default all end
    # where they leave it.
    far: Optional[Distance] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    plot: bool = False  # whether to draw some of the paths and the object beside `out`, as .png
    overwrite: bool = False  # whether `out`, and the drawing, may be replaced


def make_rays(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], medium: Medium, near: float, far: float | None
) -> Rays:
    """Rays of the given range; without `far`, of one that leads all of them out of the medium's box."""
    if far is None:
        centre, diagonal = medium.box.mean(0), float(torch.linalg.vector_norm(medium.box[1] - medium.box[0]))
        distance = float(torch.linalg.vector_norm(origins - centre, dim=-1).max())
        far = max(distance, near) + (_DIAGONALS + 0.5) * diagonal
    if not 0 <= near < far:
        raise NerfroError(f"near={near}, far={far} is no range; near must be at least 0 and below far")
    ones = torch.ones(len(origins))
    return Rays(origins, directions, 0 * ones, near * ones, far * ones)


def leave_box(path: Path, medium: Medium) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"]]:
    """Where and at which arc length paths leave the box; those that miss it stay where they begin."""
    # The last vertex before the end that is not a repetition of it.
    last = (path.s < path.far[:, None]).sum(-1).sub(1).clamp(min=0)
    rows = torch.arange(len(last))
    start = path.positions[rows, last]
    enter, leave = intersect_box(medium.box, start, path.exit_directions)
    ahead = torch.where(enter < leave, leave, 0.0).clamp(min=0).minimum(path.far - path.s[rows, last])
    return start + ahead[:, None] * path.exit_directions, path.s[rows, last] + ahead


def read_rays(file: FilePath) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Origins and unit directions from a file."""
    arrays = load_arrays(file)
    for name in ("origins", "directions"):
        if name not in arrays:
            raise NerfroError(f"{file} has no array '{name}'; it needs origins and directions, both [R, 3]")
        if arrays[name].ndim != 2 or arrays[name].shape[1] != 3 or len(arrays[name]) == 0:
            raise NerfroError(f"{name} in {file} has shape {arrays[name].shape}; it must be [R, 3], not empty")
        if arrays[name].dtype.kind not in "fiu":
            raise NerfroError(f"{name} in {file} are {arrays[name].dtype}; they must be real numbers")
        arrays[name] = arrays[name].astype(np.float64)
        check(f"{file}: ", {name: Coordinate}, {name: float(np.abs(arrays[name]).max())})
    origins, directions = arrays["origins"], arrays["directions"]
    if origins.shape != directions.shape:
        raise NerfroError(f"{file} has {len(origins)} origins and {len(directions)} directions; give one for each ray")
    norms = np.linalg.norm(directions, axis=1)
    if (np.abs(norms - 1) > 1e-3).any():
        raise NerfroError(f"directions in {file} have lengths from {norms.min():g} to {norms.max():g}; make them 1")
    unit = directions / norms[:, None]
    return torch.from_numpy(origins.astype(np.float32)), torch.from_numpy(unit.astype(np.float32))
