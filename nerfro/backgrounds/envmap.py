"""A texture of the whole sphere as the background."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from omegaconf import DictConfig
from torch import Tensor, nn

from nerfro.backgrounds import cube_map
from nerfro.backgrounds.base import Background
from nerfro.core.errors import NerfroError
from nerfro.core.light import GREY, unbounded_radiance
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.files import lat_long
from nerfro.geometry.space import Space
from nerfro.registry.allowed import Count
from nerfro.registry.registration import register

# Texels along each side of a face of the levels, if neither a list nor photographs define them.
_RESOLUTIONS = (4, 8, 16, 32, 64, 128, 256)
# Bounds of the finest level that is derived from photographs.
_MIN_RESOLUTION, _MAX_RESOLUTION = 64, 1024
# Bounds of the finest level of gradient descent, whose optimizer visits all texels in each step: with and without finer
# levels that `phase=background` fits.
_MAX_BESIDE_FITS, _MAX_ALONE = 256, 512
# Training steps after the first fit without gradient descent. While the field is empty, the map would learn the colours
# of objects inside the glass.
_FIRST_STEP = 100


@dataclass(frozen=True)
class Observed:
    """Radiance that was observed from directions.

    Attributes:
        directions: unit directions of rays.
        radiance: linear radiance of each ray.
        saturated: channels in which the radiance is a lower bound.
        weights: weight of each ray.
        widths: angle in radians over which the radiance of each ray is a mean.
    """

    directions: Float[Tensor, "observations 3"]
    radiance: Float[Tensor, "observations 3"]
    saturated: Bool[Tensor, "observations 3"]
    weights: Float[Tensor, " observations"]
    widths: Float[Tensor, " observations"]

    def __getitem__(self, chosen: Bool[Tensor, " observations"]) -> Observed:
        return Observed(*(value[chosen] for value in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Observed]) -> Observed:
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return parts[0] if len(parts) == 1 else cls(*map(torch.cat, columns))


def _is_fitted(settings: DictConfig) -> bool:
    """Return whether `phase=background` takes steps."""
    return ((settings.phase.get("background") or {}).get("steps") or 0) > 0


@register("background", "envmap")
class EnvironmentMap(Background):
    """Squared softplus of a sum of cube maps of increasing resolution.

    Coarse levels fill in directions that no ray has sampled. The map has no preferred axis. It is initialized
    to an even grey or to a given image.

    Args:
        resolutions: texels along each side of a face (90 degrees) of each level, ascending. None derives the finest
            level from the width of a pixel of the photographs. If a volume covers all of space, the background shows
            only what is far behind the photographed scene, and None has levels from 4 to 256 texels, as with given
            `fitted_resolutions`.
        fitted_resolutions: the same of finer levels, which only the fits of `phase=background` change. Gradient descent
            would visit all their texels in each step. None derives the levels from the photographs, too, unless
            `resolutions` is given.
        image: initial equirectangular image with z up (.png, .jpg, .hdr or .exr); None for grey.

    Attributes:
        levels: layout of all levels.
        texels: raw values of the levels `resolutions`.
        fitted_texels: raw values of the levels `fitted_resolutions`.
    """

    padded: Int[Tensor, " padded"]
    fitted_texels: Float[Tensor, "F 3"]

    def __init__(
        self,
        resolutions: list[Count] | None = None,
        fitted_resolutions: list[Count] | None = None,
        image: str | None = None,
    ) -> None:
        super().__init__()
        resolutions = list(_RESOLUTIONS) if resolutions is None else resolutions
        if len(resolutions) == 0:
            raise NerfroError("background=envmap: resolutions is empty; give one or more")
        fitted = [] if fitted_resolutions is None else fitted_resolutions
        levels = [*resolutions, *fitted]
        if any(finer <= coarser for coarser, finer in itertools.pairwise(levels)):
            raise NerfroError(
                f"background=envmap: the levels {levels} do not ascend; give resolutions, and then fitted_resolutions, "
                "in ascending order"
            )
        self.levels = cube_map.CubeLevels(tuple(levels))
        self._groups = cube_map.CubeLevels(tuple(resolutions)), cube_map.CubeLevels(tuple(fitted))
        of_descent, of_fits = (torch.zeros(levels.num_texels, 3) for levels in self._groups)
        self.texels = nn.Parameter(of_descent)
        self.register_buffer("fitted_texels", of_fits, persistent=len(fitted) > 0)
        padded = torch.cat([cube_map.padded_texels(n).flatten() for n in self.levels.resolutions])
        self.register_buffer("padded", padded, persistent=False)
        if image is not None:
            self.set_lat_long(lat_long.load_lat_long(image))

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        given = settings.background.resolutions, settings.background.fitted_resolutions
        if space.infinite or given != (None, None):
            return {}
        fits = _is_fitted(settings)
        pixels = 0.5 * math.pi * float(views.cameras.fx.double().median())
        limit = _MAX_RESOLUTION if fits else _MAX_ALONE
        finest = min(max(2 ** round(math.log2(pixels)), _MIN_RESOLUTION), limit)
        levels = [2**level for level in range(int(math.log2(_RESOLUTIONS[0])), int(math.log2(finest)) + 1)]
        descent = [n for n in levels if n <= _MAX_BESIDE_FITS or not fits]
        return {"resolutions": descent, "fitted_resolutions": levels[len(descent) :]}

    @classmethod
    def learns_from(cls, settings: DictConfig) -> int:
        return _FIRST_STEP if _is_fitted(settings) and settings.content.space == "box" else 0

    @classmethod
    def of_texels(cls, radiance: Float[Tensor, "T 3"]) -> EnvironmentMap:
        """Make a map with fixed linear radiance at the `cube_map.texel_directions` of one level."""
        sky = cls([math.isqrt(len(radiance) // 6)])
        sky.requires_grad_(False).texels.copy_(_raw(radiance))
        return sky.eval()

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        face, coordinates = cube_map.project(exits.directions.float().reshape(-1, 3))
        return unbounded_radiance(self._raw_at(face, coordinates)).view(exits.directions.shape)

    @property
    def face_resolution(self) -> int:
        return self.levels.resolutions[-1]

    @property
    def detail(self) -> float:
        return 90 / max(self._groups[0].resolutions)

    def _raw_at(self, face: Int[Tensor, "P"], coordinates: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        padded = self.padded.split([levels.num_padded for levels in self._groups])
        groups = zip((self.texels, self.fitted_texels), padded, self._groups, strict=True)
        raw, *finer = [
            cube_map.lookup(face, coordinates, texels, of_group, levels.resolutions)
            for texels, of_group, levels in groups
            if levels.resolutions
        ]
        return sum(finer, start=raw)

    def texels_of_levels(self) -> list[tuple[Float[Tensor, "T 3"], Int[Tensor, " padded"]]]:
        """Return the raw values of each level, and the texels of the faces with margins (`cube_map.padded_texels`)."""
        groups = zip((self.texels, self.fitted_texels), self._groups, strict=True)
        texels = [values for group, levels in groups for values in group.split(levels.sizes)]
        return list(zip(texels, self.padded.split(self.levels.padded_sizes), strict=True))

    @torch.no_grad()
    def fit(self, observed: Observed, weights: Float[Tensor, "T"]) -> None:
        """Move the texels towards observed radiance, level by level from coarse to fine.

        A texel moves by the weighted mean of the residuals of its rays before the softplus. The mean includes residuals
        of zero with the weight of past observations plus one. Therefore, texels keep the mean of all observations, and
        rarely observed texels stay close to the coarser levels.

        Args:
            observed: radiance from directions.
            weights: weight of past observations of each texel, to which these are added: the sum over rays of bilinear
                weight times weight of the ray.
        """
        face, coordinates = cube_map.project(observed.directions.float())
        # Darker radiance counts as that of the smallest step of 8-bit images.
        residual = _raw(observed.radiance.clamp(min=1 / 255 / 12.92)) - self._raw_at(face, coordinates)
        residual = torch.where(observed.saturated, residual.clamp(min=0), residual)
        levels = zip(self.levels.resolutions, self.texels_of_levels(), weights.split(self.levels.sizes), strict=True)
        for n, (values, of_level), total in levels:
            # A ray contributes to levels of which it is at most two texels wide.
            of_rays = observed.weights.masked_fill(observed.widths > math.pi / n, 0)[:, None].expand(-1, 3)
            with torch.enable_grad():
                texels = values.detach().requires_grad_()
                interpolated = cube_map.lookup(face, coordinates, texels, of_level, (n,))
            # The finest level has most of the memory of a run, so it exists as few times as possible.
            total += torch.autograd.grad(interpolated, texels, of_rays, retain_graph=True)[0][:, 0]
            change = torch.autograd.grad(interpolated, texels, of_rays * residual)[0]
            for change_of_face, total_of_face in zip(change.chunk(6), total.chunk(6), strict=True):
                change_of_face /= (total_of_face + 1)[:, None]
            values += change
            residual -= cube_map.lookup(face, coordinates, change, of_level, (n,))
            del change

    @torch.no_grad()
    def set_lat_long(self, radiance: Float[Tensor, "H 2*H 3"]) -> None:
        """Set the finest level to the linear radiance of an equirectangular image, and the coarser levels to zero."""
        n = self.levels.resolutions[-1]
        radiance = lat_long.sample(radiance, cube_map.texel_directions(n), width=4 * n)
        for texels in (self.texels, self.fitted_texels):
            texels.zero_()
        self.texels_of_levels()[-1][0].copy_(_raw(radiance))


def _raw(radiance: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    """Invert `unbounded_radiance`; the darkest value is slightly above black."""
    y = (radiance.sqrt() / GREY).clamp(min=1e-3)
    return y + torch.log(-torch.expm1(-y))
