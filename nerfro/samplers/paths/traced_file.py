"""Input, configuration and results of `python -m nerfro.trace`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import MISSING
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path, Rays
from nerfro.files.reading import load_arrays
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.base import Medium
from nerfro.registry.allowed import Coordinate, Distance, check


@dataclass
class TraceSamplerConfig:
    """Configuration of the group `sampler`."""

    path: Any = MISSING


@dataclass
class TraceConfig:
    """Options of `python -m nerfro.trace`, which traces rays of a file through a medium.

    Attributes:
        medium: plugin of the group `medium`.
        rays: .npz file with `origins` and `directions` [R, 3], world units and unit directions.
        out: .npz file to write, with `exit_positions` and `exit_directions` [R, 3], `path_lengths`, `hit` and
            `events` (refractions and reflections) [R]. If rays split, there is one row for each polyline, and the
            arrays `ray` (row in `rays`) and `throughput` [P, 3].
        near: arc length at which paths begin.
        far: arc length at which paths end. Bent paths end outside the box of the medium, beyond `far` if
            necessary. By default, all paths end at the exit from the box.
        plot: whether to plot some of the paths and the medium as .png beside `out`.
        overwrite: whether to replace `out` and the plot.
    """

    medium: Any = MISSING
    sampler: TraceSamplerConfig = dataclasses.field(default_factory=TraceSamplerConfig)
    rays: str = MISSING
    out: str = MISSING
    near: Distance = 0.0
    far: Distance | None = None
    plot: bool = False
    overwrite: bool = False


def make_rays(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    medium: Medium,
    near: float,
    far: float | None,
    dtype: torch.dtype = torch.float32,
) -> Rays:
    """Create rays relative to the medium's origin, from near to far.

    Without `far`, the paths are long enough to leave the medium's box.
    """
    origins, directions = (origins - torch.from_numpy(medium.origin)).to(dtype), directions.to(dtype)
    if far is None:
        centre, diagonal = medium.box.mean(0), float(torch.linalg.vector_norm(medium.box[1] - medium.box[0]))
        distance = float(torch.linalg.vector_norm(origins.detach() - centre, dim=-1).max())
        # Paths end two diagonals beyond the box of the medium, because reflected paths are long.
        far = max(distance, near) + 2.5 * diagonal
    if not 0 <= near < far:
        raise NerfroError(f"near={near}, far={far} is no range; near must be at least 0 and below far")
    ones = torch.ones(len(origins), dtype=dtype)
    return Rays(origins, directions, 0 * ones, near * ones, far * ones)


def leave_box(path: Path, box: Float[Tensor, "2 3"]) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"]]:
    """Return positions and arc lengths of the exits from a box, or of the first vertex for rays beside the box."""
    # Short rows repeat the last vertex, so the last event is the last vertex before far.
    last = (path.s < path.far[:, None]).sum(-1).sub(1).clamp(min=0)
    rows = torch.arange(len(last))
    start = path.positions[rows, last]
    enter, leave = intersect_box(box, start, path.exit_directions)
    ahead = torch.where(enter < leave, leave, 0.0).clamp(min=0).minimum(path.far - path.s[rows, last])
    return start + ahead[:, None] * path.exit_directions, path.s[rows, last] + ahead


def read_rays(file: FilePath) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Read origins and unit directions from a file, in double precision."""
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
    return torch.from_numpy(origins), torch.from_numpy(unit)
