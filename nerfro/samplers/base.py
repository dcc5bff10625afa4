"""Base classes of path samplers and point samplers, and straight paths, as in ordinary radiance fields."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from nerfro.core.draws import Draws
from nerfro.core.types import Path, Rays, Rendering, Samples
from nerfro.data.component import Component, require_results
from nerfro.fields.base import Field
from nerfro.media.base import Medium
from nerfro.registry.registration import register
from nerfro.samplers.paths.branching import ONE_PATH
from nerfro.samplers.paths.polylines import SnellTrace


class PathSampler(nn.Module, ABC):
    """Turn rays into paths. Paths are traced without gradients, and replayed with them if parameters learn from them.

    Attributes:
        needs_medium: whether the sampler queries the medium; otherwise no medium is built.
        ends_at_far: whether bent paths end at far even in the medium, as those of some published methods do.
        traces_triangles: whether the sampler intersects the triangles of bodies instead of their signed distances.
        branching: rule that selects the branches of partly reflected light.
        max_events, wavelengths: settings of the interactive page, which traces rays as `snell` does.
    """

    needs_medium = True
    ends_at_far = False
    traces_triangles = False
    branching = ONE_PATH
    max_events = 16
    wavelengths: Sequence[float] = (610.0, 550.0, 465.0)

    @classmethod
    def settings_for(cls, medium: Medium) -> dict[str, Any]:
        """Choose values of settings that are None in a training of a medium, by the names of constructor parameters."""
        return {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        contract = "a Path with a polyline for each ray, as by Path.unbranched"
        require_results(cls, Path, contract, lambda path, rays: path.num_rays == len(rays))

    @abstractmethod
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace rays from near to far through the medium.

        Args:
            rays: R rays with unit directions; lengths in world units, relative to `medium.origin`.
            medium: refractive index.

        Returns:
            P polylines, at least one for each ray. Bent paths end outside of `medium.box`, beyond far if
                necessary, unless the sampler declares `ends_at_far`.
        """

    def trace(self, rays: Rays, medium: Medium) -> SnellTrace:
        """Trace rays, and count the events of each polyline; samplers that do not override this method count none."""
        return SnellTrace.without_events(self(rays, medium))

    def trace_main(self, rays: Rays, medium: Medium) -> Path:
        """Trace only the first polyline of each ray, which is enough to find the exit directions."""
        return self(rays, medium)

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        """Return a traced path with the same values, and gradients with respect to rays and medium.

        Moving silhouettes, and events that appear or disappear, have no gradients.
        """
        return path

    def replay_rows(self, path: Path, rays: Rays, medium: Medium, rows: Int[Tensor, " rows"]) -> Path:
        """Replay some polylines of a traced path; the others keep their values without gradients.

        Args:
            path: traced path.
            rays: traced rays.
            medium: traced medium.
            rows: the polylines, each at most once.
        """
        if len(rows) == len(path.s):
            return self.replay(path, rays, medium)
        if not len(rows):
            return path
        replayed = self.replay(path[rows], rays[path.ray[rows]], medium)
        names = ["positions", "directions", "s", *(["throughput"] if path.splits else [])]
        columns = {name: getattr(path, name).index_copy(0, rows, getattr(replayed, name)) for name in names}
        return replace(path, **columns)

    def steady(self, path: Path, medium: Medium) -> Bool[Tensor, "P"]:
        """Return which traced paths have bounded derivatives; training uses no derivatives of the other paths."""
        return torch.ones_like(path.refracted)

    def releases_gil(self, medium: Medium) -> bool:
        """Return whether tracing on the CPU hardly holds the global interpreter lock, so that other threads run.

        This is true of compiled kernels and of a few operators. Batches of a training on another device are then made
        on the CPU, with copies of the medium and of the samplers.
        """
        return False


class PointSampler(Component, nn.Module, ABC):
    """Choose arc lengths on a path.

    Attributes:
        num_levels: number of sampling levels; each level uses the rendering of the previous one.
    """

    num_levels: int

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        contract = "Samples on all polylines of the path, as by point_samples(path, s) with s [P, N]"
        require_results(cls, Samples, contract, lambda samples, path: len(samples.s) == len(path.s))

    @abstractmethod
    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        """Sample a path.

        Args:
            path: P polylines in arc length.
            previous: rendering of the previous level; None at the first level.
            draws: random numbers of the training step; None in evaluation, where samples are deterministic. All
                randomness comes from `draws.for_rays(path.ray, num)`, so that all polylines of a ray share their
                numbers, and so that a run that resumes repeats the steps of an undisturbed run.

        Returns:
            Samples in ascending arc length; `Samples.along` looks up positions and directions on the path.
        """

    def choose_ahead(self, path: Path, draws: Draws) -> Samples | None:
        """Return the samples of the first level of a traced path, or None to choose them in the step.

        A thread may choose the samples of the next step during a step, so they may depend on the state that
        `update` updates, but on no learned parameter. This state is in buffers, because batches of a training on
        another device are made by a copy on the CPU.
        """
        return None

    def update(self, fields: Sequence[Field], draws: Draws) -> None:
        """Update the state of the sampler before a training step, except the first.

        Args:
            fields: radiance field of each sampling level after `draws.step` training steps.
            draws: random numbers of the next step.
        """


@register("sampler/path", "straight")
class Straight(PathSampler):
    """Trace straight rays, o + s d, and ignore the medium."""

    needs_medium = False

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Return a path of two vertices for each ray."""
        return straight_path(rays)

    def releases_gil(self, medium: Medium) -> bool:
        return True

    def replay(self, path: Path, rays: Rays, medium: Medium) -> Path:
        return replay_straight(path, rays)


def straight_path(rays: Rays) -> Path:
    """Return paths of two vertices, at near and far."""
    s = torch.stack([rays.near, rays.far], -1)
    positions = rays.origins[:, None] + s[..., None] * rays.directions[:, None]
    directions = rays.directions[:, None].expand_as(positions)
    refracted = torch.zeros(len(rays), dtype=torch.bool, device=s.device)
    return Path.unbranched(positions, directions, s, refracted, rays.radii)


def replay_straight(path: Path, rays: Rays) -> Path:
    """Return straight paths with gradients with respect to the rays."""
    lines = straight_path(rays[path.ray])
    return replace(path, positions=lines.positions, directions=lines.directions, s=lines.s)
