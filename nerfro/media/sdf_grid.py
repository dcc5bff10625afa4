"""Homogeneous bodies: signed distances on a grid for each body, with a continuous gradient."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.variants import variant
from nerfro.geometry.intersection import LayeredIntersector, Triangles
from nerfro.geometry.mesh import TriangleMesh, local_origin
from nerfro.kernels.available import require_bytes
from nerfro.media.base import Medium, Vectors
from nerfro.media.bodies import Body, mesh_surface, read_bodies
from nerfro.media.distance_grid import DistanceGrid, DistanceGrids
from nerfro.media.grid_box import BYTES_PER_VERTEX, grid_box
from nerfro.media.material import Learns, learned_quantities, materials_of
from nerfro.media.solid import Solid, body_names
from nerfro.media.surface import Grid, make_surface
from nerfro.registry.allowed import NotNegative, Positive, Resolution
from nerfro.registry.registration import register

if TYPE_CHECKING:
    from nerfro.kernels.lookup import Solids


@register("medium", "sdf_grid")
class SdfGrid(Solid):
    """Bodies of constant index with closed surfaces, which are sharp for `snell` and thin shells for `eikonal`.

    Each body has its own grid in its own box, so bodies may be nested, apart, or overlap. A point belongs to the last
    body that contains it.

    Args:
        mesh: closed triangle mesh of the outer body, world units, any format trimesh reads; with `bodies`, the mesh of
            bodies that have none.
        ior: refractive index inside the mesh.
        inner_meshes: meshes of inner bodies (a liquid, a bubble). Opaque objects do not belong here, because they do
            not refract.
        inner_iors: refractive index of each inner body.
        learn_ior: refine the refractive indices of all bodies without a setting `learn` in training.
        resolution: vertices along each side of the grid of each body.
        box_min, box_max: corners of all grids, world units; None for the bounds of each mesh and a margin of air.
        shell_voxels: half width of the smooth interface that the Eikonal equation sees, voxels.
        accept_open_mesh: accept meshes with holes. Rays along three axes decide by majority whether a point is inside.
        absorption: absorption coefficients per world unit: red, green and blue of each body, or one number for all;
            only for `sampler/path=snell`.
        learn_absorption: learn the absorption of the same bodies; only for `sampler/path=snell`.
        abbe: Abbe number of each body, or one for all bodies, for dispersion; only for `sampler/path=snell`.
        cache: keep the distances in the cache folder.
        bodies: bodies by name, with the settings mesh or surface, ior or material, abbe, absorption, priority and learn
            of each (`media.bodies.BodySettings`); replaces `ior` and the lists of all bodies.

    Attributes:
        meshes: the meshes of the bodies; empty if a body has none.
        grids: signed distances of each body.
    """

    grids: DistanceGrids
    _content_box: Float[Tensor, "2 3"] | None

    def __init__(
        self,
        mesh: str | None = None,
        ior: Positive = 1.5,
        inner_meshes: list[str] = [],  # noqa: B006 (the registry reads and copies it)
        inner_iors: Sequence[Positive] = (),
        resolution: Resolution = 128,
        box_min: Sequence[float] | None = None,
        box_max: Sequence[float] | None = None,
        shell_voxels: Positive = 0.1,
        accept_open_mesh: bool = False,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: Learns = False,
        abbe: Sequence[Positive] = (),
        learn_ior: Learns = False,
        cache: bool = True,
        bodies: dict[str, Any] | None = None,
    ) -> None:
        if len(inner_meshes) != len(inner_iors):
            raise NerfroError(
                f"medium.inner_meshes has {len(inner_meshes)} entries and medium.inner_iors {len(inner_iors)}; "
                "give one index for each inner mesh"
            )
        if bodies is not None:
            short = {"inner_meshes": inner_meshes, "absorption": absorption, "abbe": abbe}
            given = [name for name, value in short.items() if value]
            if given:
                raise NerfroError(f"medium.{given[0]} has no meaning beside bodies; set it for each body")
            members = read_bodies(bodies, mesh, learned_quantities(learn_ior, learn_absorption))
        elif mesh is None:
            raise NerfroError(
                "medium=sdf_grid needs mesh; add medium.mesh=..., or bodies={NAME: {mesh: FILE, ior: 1.5}}"
            )
        else:
            materials = materials_of([ior, *inner_iors], absorption, learn_absorption, abbe, learn_ior)
            names, files = body_names(len(materials)), map(mesh_surface, [mesh, *inner_meshes])
            members = [Body(*body) for body in zip(names, files, materials, strict=True)]
        require_bytes(len(members) * BYTES_PER_VERTEX * resolution**3, f"medium.resolution={resolution}")
        surfaces = [make_surface(body.surface, accept_open_mesh) for body in members]
        boxes = [grid_box(box_min, box_max, surface.bounds, resolution) for surface in surfaces]
        spacing = min(float((box[1] - box[0]).min()) for box in boxes) / (resolution - 1)
        Medium.__init__(self)
        self._set_materials([body.material for body in members], [body.name for body in members])
        self.shell = shell_voxels * spacing
        self.origin = local_origin(surfaces[0].bounds)
        meshes = [surface.mesh.relative_to(self.origin) for surface in surfaces if surface.mesh is not None]
        self.meshes = meshes if len(meshes) == len(surfaces) else []
        bounds = np.stack([surface.bounds for surface in surfaces], 1) - self.origin
        self._content_box = torch.from_numpy(np.stack([bounds[0].min(0), bounds[1].max(0)])).float()
        grids = []
        for body, surface, box in zip(members, surfaces, boxes, strict=True):
            relative = torch.from_numpy(box - self.origin).float()  # rounded before the distances are computed
            distances = surface.distances(Grid(relative.double().numpy() + self.origin, resolution, cache=cache))
            if not (distances < 0).any():
                raise NerfroError(
                    f"no vertex of the grid lies inside the body {body.name}; make it thicker than a voxel, or raise "
                    "medium.resolution"
                )
            grids.append(DistanceGrid(torch.from_numpy(distances).float(), relative))
        self._set_grids(grids)
        self.scale_absorption(torch.from_numpy(surface.bounds) for surface in surfaces)

    @classmethod
    def from_distances(
        cls,
        distances: Iterable[Float[Tensor, "X Y Z"]],
        boxes: Float[Tensor, "2 3"] | Sequence[Float[Tensor, "2 3"]],
        iors: Sequence[float],
        shell: float,
        **glass: Any,
    ) -> SdfGrid:
        """Make the medium from signed distances.

        Args:
            distances: of each body at the vertices of a grid, world units; negative inside, positive at the border.
            boxes: lower and upper corner of each grid, or of all grids, world units.
            iors: refractive index of each body.
            shell: half width of the smooth interface, world units.
            glass: further arguments of `Solid`.
        """
        medium = cls.__new__(cls)
        Solid.__init__(medium, iors, shell, **glass)
        medium.meshes, medium._content_box = [], None
        boxes = [boxes] * len(iors) if isinstance(boxes, Tensor) else boxes
        medium._set_grids(DistanceGrid(values, box) for values, box in zip(distances, boxes, strict=True))
        medium.scale_absorption(grid.box for grid in medium.grids)
        return medium

    def _set_grids(self, grids: Iterable[DistanceGrid]) -> None:
        self.grids = DistanceGrids(grids)
        low, high = torch.stack([grid.box for grid in self.grids], 1).unbind()
        self.register_buffer("box", torch.stack([low.amin(0), high.amax(0)]), persistent=False)

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the surfaces, world units; the box of the grids if the medium was made from distances."""
        return self.box if self._content_box is None else self._content_box

    def grown(self, outwards: Float[Tensor, "X Y Z"]) -> SdfGrid:
        """Return the same bodies with the surface of the first body displaced.

        The displacement is subtracted from the distances, so the distances are exact only for small displacements.

        Args:
            outwards: outward displacement at the vertices of the first body's grid, world units.
        """
        first, *others = self.grids
        changed = variant(self, meshes=[], _content_box=None)
        changed._set_grids([DistanceGrid(first.distances - outwards, first.box), *others])
        return changed

    def packed(self) -> Solids:
        """Return the bodies as kernels take them."""
        from nerfro.kernels.lookup import Solids

        low, high = self.box.double().cpu().numpy()
        indices, absorbs = self.indices.double().cpu().numpy(), self.absorbs.cpu().numpy()
        return Solids._make((*self.grids.packed, indices, absorbs, self.nested, self.shell, low, high))

    @cached_property
    def triangles(self) -> Triangles:
        """Triangles of all meshes."""
        return Triangles.of(self.meshes)

    @cached_property
    def intersector(self) -> LayeredIntersector:
        """Intersector of `triangles`."""
        return LayeredIntersector(self.triangles.corners, self.outline.faces)

    @property
    def outline(self) -> TriangleMesh:
        """Triangles of all meshes as one mesh, whose projection is the silhouette of the bodies."""
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        faces = [mesh.faces + start for mesh, start in zip(self.meshes, starts, strict=False)]
        return TriangleMesh(np.concatenate([mesh.vertices for mesh in self.meshes]), np.concatenate(faces))

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Interpolate the distances by splines, with their exact gradients."""
        splines = [grid(positions) for grid in self.grids]
        return torch.stack([phi for phi, _ in splines], -1), torch.stack([gradient for _, gradient in splines], -2)
