"""Bodies of constant index with sharp surfaces, which the Eikonal equation sees as thin smooth shells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path
from nerfro.core.variants import variant
from nerfro.geometry.bodies import WallSettings, thickness
from nerfro.geometry.intersection import Triangles, TriangleTree, layers
from nerfro.geometry.mesh import TriangleMesh, local_origin, num_decimals
from nerfro.geometry.space import corners_of_box
from nerfro.kernels.available import require_bytes
from nerfro.kernels.constants import constant
from nerfro.kernels.tolerances import MIN_COSINE, SAFE_SHARE, STEPS_PER_SHELL
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.media.distance_grid import DistanceGrid, DistanceGrids
from nerfro.media.material import Material
from nerfro.media.surfaces import Grid, Surface
from nerfro.registry.allowed import Positive, Resolution

if TYPE_CHECKING:
    from nerfro.kernels.lookup import Solids

BYTES_PER_VERTEX = 64  # peak memory while a grid is built
COLOURS = ("red", "green", "blue")
_RESOLUTION = 128  # vertices along each side of a grid without thin walls
_AIR = 4  # voxels around a body if the box of its grid is not given
# Paths record bodies as 8-bit integers.
_MAX_BODIES = 127


@dataclass(frozen=True)
class Body:
    """A body of constant index.

    Attributes:
        name: name of the body in messages and in the names of parameters.
        surface: closed surface.
        material: refractive index, dispersion and absorption.
        priority: where bodies overlap, the one with the highest priority decides; of equal ones the last.
    """

    name: str
    surface: Surface
    material: Material
    priority: int = 0


@dataclass(frozen=True)
class GridSettings:
    """Settings of the grids of signed distances, one for each body.

    Attributes:
        resolution: vertices along each side of a grid; None for 128, and more if a body has free thin walls.
        box_min, box_max: corners of all grids, world units; None for the bounds of each surface and a margin of air.
        shell_voxels: half width of the smooth interface that the Eikonal equation sees, voxels.
        cache: whether the distances are kept in the cache folder.
        max_gigabytes: memory up to which thin walls raise the resolution of a grid, while the grid is built.
    """

    resolution: Resolution | None = None
    box_min: Sequence[float] | None = None
    box_max: Sequence[float] | None = None
    shell_voxels: Positive = 0.1
    cache: bool = True
    max_gigabytes: Positive = 3.0

    def for_body(self, name: str, surface: Surface, others: Sequence[Surface]) -> GridSettings:
        """Return the same settings with a resolution at which the walls of a body have enough voxels.

        Args:
            name: name of the body, for a line about its walls.
            surface: surface of the body.
            others: surfaces of the other bodies; walls that separate the body from another one count as thick.
        """
        if self.resolution is not None:
            return self
        coarse = replace(self, resolution=_RESOLUTION)
        mesh, meshes = surface.mesh, [other.mesh for other in others if other.mesh is not None]
        if mesh is None or not mesh.is_closed:
            return coarse
        try:
            walls = thickness(mesh, [other for other in meshes if other.is_closed])
        except NerfroError:  # without Embree
            return coarse
        spacing = float(np.ptp(coarse.box(surface), axis=0).max()) / (_RESOLUTION - 1)
        thin = walls < WallSettings.voxels * spacing
        if thin.mean() <= WallSettings.few:
            return coarse
        # The margin of air has a fixed number of voxels if the box follows the surface.
        air = 0 if self.box_min is not None else 2 * _AIR
        thickest = float(np.quantile(walls, WallSettings.few, method="lower"))  # of the walls that may stay thin
        finer = (_RESOLUTION - 1 - air) * WallSettings.voxels * spacing / thickest
        most = int((self.max_gigabytes * 1e9 / BYTES_PER_VERTEX) ** (1 / 3))
        resolution = max(_RESOLUTION, min(math.ceil(finer) + 1 + air, most))
        print(
            f"nerfro: the grid of {name} has {resolution} vertices along each side (medium.resolution), because walls "
            f"of its surface are about {np.median(walls[thin]):.3g} world units thin"
        )
        return replace(self, resolution=resolution)

    def box(self, surface: Surface) -> Float[np.ndarray, "2 3"]:
        """Return the corners of the grid of a surface, world units.

        A flat body gets a box at least half as thick as it is long, because voxels should not be much longer than wide.

        Raises:
            NerfroError: one corner is given without the other, the corners do not make a box, or the surface does not
                fit into it.
        """
        low, high = surface.bounds
        resolution = self.resolution or _RESOLUTION
        if self.box_min is not None and self.box_max is not None:
            box = corners_of_box(self.box_min, self.box_max)
            check_margin(surface.bounds, box, resolution, 2)
            return box
        if self.box_min is not None or self.box_max is not None:
            raise NerfroError(
                "medium.box_min and medium.box_max belong together; give both, or neither for the bounds of the mesh"
            )
        sides = np.maximum(high - low, 0.5 * (high - low).max())
        share = min(2 * _AIR / (resolution - 1), 0.5)
        return 0.5 * (low + high) + np.array([[-0.5], [0.5]]) * sides / (1 - share)

    def require_memory(self, num_bodies: int) -> None:
        """Refuse grids that need more memory than is available."""
        resolution = self.resolution or _RESOLUTION
        require_bytes(num_bodies * BYTES_PER_VERTEX * resolution**3, f"medium.resolution={resolution}")


class Bodies(Medium):
    """Bodies of constant index, which are sharp for `snell` and thin shells for `eikonal`.

    Each body has a grid of signed distances in its own box, so bodies may be nested, apart, or overlap. Bodies have
    an order, from the lowest priority to the highest, and the last body at a point decides there (Schmidt and Budge
    2002, "Simple Nested Dielectrics in Ray Traced Images").

    For the Eikonal equation the surface is a shell of half width w around the zero level. In the shell the index rises
    as a cubic step of the signed distance phi: S = t^2 (3 - 2 t), t = (1 - phi / w) / 2. The bodies are applied in
    order, n <- n + (ior - n) S; a `nested` medium uses the product of all steps so far in place of S.

    Args:
        bodies: at least one body.
        nested: whether a body exists only where all bodies before it exist. A nested body may then reach beyond the
            others and touch them without a gap, and a clear body of index 1 is air, as outside. Otherwise a point
            belongs to the last body that contains it.
        grid: settings of the grids.

    Attributes:
        names: name of each body.
        materials: material of each body.
        grids: signed distances of each body.
        meshes: triangles of each surface, relative to `origin`; empty if a surface has none.
        shell: half width w of the smooth shells, world units.

    Raises:
        NerfroError: there are too many bodies, or a surface does not fit its grid.
    """

    materials: Sequence[Material]
    grids: DistanceGrids

    def __init__(self, bodies: Sequence[Body], nested: bool = False, grid: GridSettings = GridSettings()) -> None:
        super().__init__()
        bodies = sorted(bodies, key=lambda body: body.priority)
        grid.require_memory(len(bodies))
        surfaces = [body.surface for body in bodies]
        self.origin, self.nested = local_origin(surfaces[0].bounds), nested
        self._set_materials([body.name for body in bodies], [body.material for body in bodies])
        boxes, resolutions = [], []
        for body in bodies:
            settings = grid.for_body(body.name, body.surface, [s for s in surfaces if s is not body.surface])
            boxes.append(settings.box(body.surface))
            resolutions.append(settings.resolution or _RESOLUTION)
        sides = [float((box[1] - box[0]).min()) for box in boxes]
        self.shell = grid.shell_voxels * min(side / (n - 1) for side, n in zip(sides, resolutions, strict=True))
        meshes = [surface.mesh.relative_to(self.origin) for surface in surfaces if surface.mesh is not None]
        self.meshes = meshes if len(meshes) == len(surfaces) else []
        bounds = np.stack([surface.bounds for surface in surfaces], 1) - self.origin
        self._content_box = torch.from_numpy(np.stack([bounds[0].min(0), bounds[1].max(0)])).float()
        self._set_grids(
            self._sampled(body, box, resolution, grid.cache)
            for body, box, resolution in zip(bodies, boxes, resolutions, strict=True)
        )
        for body in bodies:  # so that the training is independent of the world unit
            body.material.scale_absorption(0.5 * float(np.ptp(body.surface.bounds, 0).max()))

    def _sampled(self, body: Body, box: Float[np.ndarray, "2 3"], resolution: int, cache: bool) -> DistanceGrid:
        relative = torch.from_numpy(box - self.origin).float()  # rounded before the distances are computed
        vertices = Grid(relative.double().numpy() + self.origin, resolution, cache=cache)
        sampled = body.surface.sampled(vertices, relative)
        if not (self.nested or (sampled.distances < 0).any()):
            raise NerfroError(
                f"no vertex of the grid lies inside the body {body.name}; make it thicker than a voxel, or raise "
                "medium.resolution"
            )
        return sampled

    def _set_materials(self, names: Sequence[str], materials: Sequence[Material]) -> None:
        if len(materials) > _MAX_BODIES:
            raise NerfroError(f"the medium has {len(materials)} bodies; at most {_MAX_BODIES} are allowed")
        if "ior" in materials[0].learned() and materials[0].ior.item() == 1:
            raise NerfroError(
                "the refractive index of the first body is learned from 1, the index of air, where its surface bends "
                "no ray and the index has no gradient; start from another value, such as 1.3"
            )
        self.names, self.materials = list(names), nn.ModuleList(materials)  # type: ignore[assignment]

    def _set_grids(self, grids: Iterable[DistanceGrid]) -> None:
        self.grids = DistanceGrids(grids)
        low, high = torch.stack([grid.box for grid in self.grids], 1).unbind()
        self.register_buffer("box", torch.stack([low.amin(0), high.amax(0)]), persistent=False)

    def with_grids(self, grids: Iterable[DistanceGrid]) -> Bodies:
        """Return bodies of the same materials with other surfaces, which have no triangles."""
        changed = variant(self, meshes=[])
        changed._set_grids(grids)
        return changed

    def grown(self, outwards: Float[Tensor, "X Y Z"]) -> Bodies:
        """Return the same bodies with the surface of the first body displaced.

        The displacement is subtracted from the distances, so the distances are exact only for small displacements.

        Args:
            outwards: outward displacement at the vertices of the first body's grid, world units.
        """
        first, *others = self.grids
        moved = DistanceGrid(first.distances - outwards, first.box)
        return self.with_grids([moved, *(grid.following(outwards) for grid in others)])

    def packed(self) -> Solids:
        """Return the bodies as kernels take them."""
        from nerfro.kernels.lookup import Solids

        low, high = self.box.double().cpu().numpy()
        indices = np.append(1.0, self.indices.double().cpu().numpy())
        absorbs = np.append(False, self.absorbs.cpu().numpy())
        scene: tuple[Any, ...] = *self.grids.packed, indices, absorbs, low, high, self.nested, self.shell
        return Solids._make(scene)

    @property
    def bodies(self) -> Bodies:
        return self

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the surfaces, world units."""
        return self._content_box

    @cached_property
    def triangles(self) -> Triangles:
        """Triangles of all meshes."""
        return Triangles.of(self.meshes)

    @cached_property
    def tree(self) -> TriangleTree:
        """Tree of `triangles` for the tracer."""
        assert self.outline is not None
        # Triangles within this share of the box's diagonal count as met together, as those of touching bodies.
        offset = 1e-6 * float(torch.linalg.vector_norm(self.box.double().diff(dim=0)))
        return TriangleTree.of(self.triangles, layers(self.triangles.corners, self.outline.faces), offset)

    @property
    def outline(self) -> TriangleMesh | None:
        if not self.meshes:
            return None
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        faces = [mesh.faces + start for mesh, start in zip(self.meshes, starts, strict=False)]
        return TriangleMesh(np.concatenate([mesh.vertices for mesh in self.meshes]), np.concatenate(faces))

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in (self.box[1] - self.box[0]).tolist())
        return f"{type(self).__name__}(ior={[round(n, 4) for n in self.indices.tolist()]}, box of {size})"

    @property
    def iors(self) -> Float[Tensor, "K"]:
        return torch.stack([material.ior for material in self.materials])

    def with_indices(self, indices: Float[Tensor, "K"]) -> Bodies:
        return self._with_materials([{"ior": ior} for ior in indices.to(self.iors).unbind()])

    @property
    def absorption(self) -> Float[Tensor, "K 3"] | None:
        """Absorption coefficients of each body and colour channel, per world unit; None if all bodies are clear."""
        if not any(material.absorbs for material in self.materials):
            return None
        return torch.stack([material.absorption for material in self.materials])

    @property
    def absorbs(self) -> Bool[Tensor, "K"]:
        """Whether each body may absorb light."""
        return constant(tuple(material.absorbs for material in self.materials), self.box.device, torch.bool)

    def with_absorption_coefficients(self, absorption: Float[Tensor, "K 3"]) -> Bodies:
        return self._with_materials([{"_absorption": values if values.any() else None} for values in absorption])

    @property
    def disperses(self) -> bool:
        return any(material.dispersion is not None for material in self.materials)

    def achromatic(self) -> Bodies:
        """Return the same bodies with the index of the d line at all wavelengths."""
        return self._with_materials([{"dispersion": None}] * len(self.materials))

    def at_wavelength(self, wavelength: float) -> Bodies:
        """Return the same bodies with their indices at a wavelength in nm; gradients reach the original indices."""
        same: dict[str, object] = {"dispersion": None}
        changes = [same | {"ior": material.ior_at(wavelength)} for material in self.materials]
        return self._with_materials(changes)

    def _with_materials(self, changes: Sequence[dict[str, object]]) -> Bodies:
        changed = [variant(material, **change) for material, change in zip(self.materials, changes, strict=True)]
        return variant(self, materials=nn.ModuleList(changed))

    def with_absorption(self, path: Path) -> Path:
        of_bodies = self.absorption
        if of_bodies is None or path.record is None:
            return path
        absorption = torch.cat([torch.zeros_like(of_bodies[:1]), of_bodies]).to(path.s)
        return replace(path, record=replace(path.record, absorption=absorption))

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        others = super().parameters_by_name()
        parameters = {name: others[name] for name in others if not name.startswith("medium.materials.")}
        for name, material in zip(self.names, self.materials, strict=True):
            learned = material.learned().items()
            parameters |= {f"bodies.{name}.material.{quantity}": parameter for quantity, parameter in learned}
        return parameters

    def measurements(self) -> dict[str, float]:
        values: dict[str, float] = {}
        for body, material in zip(self.names, self.materials, strict=True):
            for quantity in material.learned():
                name, value = f"bodies.{body}.material.{quantity}", getattr(material, quantity).tolist()
                by_colour = zip(COLOURS, value, strict=True) if quantity == "absorption" else ()
                values |= {f"{name}.{colour}": coefficient for colour, coefficient in by_colour} or {name: value}
        return values

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Interpolate the signed distance to the surface of each body, negative inside, and its exact gradient.

        Far from a surface, the value is a lower bound of the distance.
        """
        splines = [grid(positions) for grid in self.grids]
        return torch.stack([phi for phi, _ in splines], -1), torch.stack([gradient for _, gradient in splines], -2)

    def regions(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Evaluate `signed_distances`; in a `nested` medium, of the part of each body inside all bodies before it."""
        phi, gradients = self.signed_distances(positions)
        if not self.nested:
            return phi, gradients
        phi, body = phi.cummax(-1)
        return phi, gradients.gather(-2, body[..., None].expand_as(gradients))

    def deciding_body(self, inside: Bool[Tensor, "*batch K"]) -> Int[Tensor, "*batch"]:
        """Return the number of the body that decides the index and absorption at a point, from 1; 0 in air.

        Args:
            inside: whether the surface of each body encloses the point.
        """
        numbers = torch.arange(inside.shape[-1] + 1, device=inside.device)
        if self.nested:
            # Air in a vessel is the air outside: a ray passes between them without an event.
            numbers[1:] *= (self.iors != 1) | self.absorbs
            return numbers[inside.long().cumprod(-1).sum(-1)]
        return torch.where(inside, numbers[1:], 0).amax(-1)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Evaluate the refractive index of the smooth shells and its exact gradient."""
        phi, normals = self.signed_distances(positions)
        in_box = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n, gradient = torch.ones_like(phi[..., 0]), torch.zeros_like(positions)
        within, rise = torch.ones_like(n)[..., None], torch.zeros_like(positions)  # product of steps, its gradient
        for body, ior in enumerate(self.iors.unbind()):
            t = (0.5 - 0.5 * phi[..., body] / self.shell).clamp(0, 1)
            step = (t * t * (3 - 2 * t))[..., None]
            slope = (6 * t * (1 - t) * (-0.5 / self.shell))[..., None] * normals[..., body, :]
            if self.nested:
                step, slope = within * step, rise * step + within * slope
                within, rise = step, slope
            gradient = gradient * (1 - step) + (ior - n)[..., None] * slope
            n = n + (ior - n) * step[..., 0]
        return torch.where(in_box, n, 1.0), torch.where(in_box[..., None], gradient, 0.0)

    def clearance(self, positions: Vectors) -> Scalars:
        """Return a lower bound of the distance to the nearest shell, world units."""
        phi, _ = self.signed_distances(positions)
        return (SAFE_SHARE * phi.abs().amin(-1) - self.shell).clamp(min=0)

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """Return the width of the shell over `STEPS_PER_SHELL`, divided by the cosine of incidence."""
        slope = torch.linalg.vector_norm(gradients, dim=-1)
        # Dividing by a gradient of zero would make derivatives nan.
        varies = slope > 0
        cosine = ((directions * gradients).sum(-1) / torch.where(varies, slope, 1.0)).abs()
        cosine = torch.where(varies, cosine, 1.0)
        return 2 * self.shell / STEPS_PER_SHELL / cosine.clamp(min=MIN_COSINE)


def check_margin(bounds: Float[np.ndarray, "2 3"], box: Float[np.ndarray, "2 3"], resolution: int, voxels: int) -> None:
    """Refuse an object that leaves fewer than `voxels` voxels of air on a side of the box."""
    low, high = bounds
    margin = voxels * (box[1] - box[0]) / (resolution - 1)
    if (low - margin >= box[0]).all() and (high + margin <= box[1]).all():
        return
    # A larger box has larger voxels, so the margin is solved for.
    share = 2 * voxels / (resolution - 1)
    if share >= 0.9:
        raise NerfroError(
            f"medium.resolution={resolution} has no room for {voxels} voxels of air on each side; increase it"
        )
    margin = 0.5 * (high - low).max() * share / (1 - share)
    decimals = num_decimals(float((high - low).max()), 3)
    raise NerfroError(
        f"the object does not fit into the box with {voxels} voxels of air; it needs a box such as "
        f"medium.box_min={_rounded(low - margin, -1, decimals)} medium.box_max={_rounded(high + margin, 1, decimals)}"
    )


def _rounded(corner: Float[np.ndarray, "3"], direction: int, decimals: int) -> str:
    outward = np.floor if direction < 0 else np.ceil
    return "[" + ",".join(f"{value:.12g}" for value in outward(corner * 10.0**decimals) / 10.0**decimals) + "]"
