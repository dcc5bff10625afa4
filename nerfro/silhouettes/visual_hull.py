"""Shape from silhouettes: the visual hull, the largest body that is consistent with all masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from skimage import measure
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.lines import nearest_point
from nerfro.geometry.mesh import TriangleMesh, merge_vertices
from nerfro.silhouettes.silhouettes import border_pixels, outline_distance


@dataclass(frozen=True)
class HullSettings(AlgorithmSettings):
    """Settings of the visual hull on a grid (`carve_grid`).

    Attributes:
        levels: number of refinements. Each halves the voxels, and evaluates only voxels near the coarser surface.
        band: width of this neighbourhood in voxels of the coarser level, more than a voxel's diagonal.
        chunk: number of points that are evaluated at once.
    """

    levels: int = 2
    band: float = 2.0
    chunk: int = 1 << 18


@dataclass(frozen=True)
class Silhouettes:
    """Silhouettes of the object in several views.

    Attributes:
        cameras: cameras of the views.
        masks: fraction of each pixel that the object covers.
        distances: signed distances of the pixel centres to the outlines, in pixels, positive inside.
        cut: views in which the image border cuts the object, so that nothing is known outside the image.
    """

    cameras: Cameras
    masks: Float[Tensor, "V H W"]
    distances: Float[Tensor, "V H W"]
    cut: Bool[Tensor, "V"]

    @classmethod
    def of(cls, cameras: Cameras, masks: Float[Tensor, "V H W"]) -> Silhouettes:
        """Compute the outlines of masks."""
        distances = torch.empty(masks.shape, dtype=torch.float32)
        for view, mask in enumerate(masks):
            distances[view] = torch.from_numpy(outline_distance(mask.numpy()))
        return cls(cameras, masks, distances, border_pixels(masks).any(1))

    def __len__(self) -> int:
        return len(self.masks)

    def select(self, views: list[int]) -> Silhouettes:
        """Select views, in the given order."""
        return Silhouettes(self.cameras.select(views), self.masks[views], self.distances[views], self.cut[views])

    def depth_inside(
        self, view: int, points: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, " points"]]:
        """Compute the distances of points to the outline of one view.

        Returns:
            Signed distance in pixels, positive inside; infinite where the view gives no information, which means
            behind the camera and outside an image whose border cuts the object. Width of a pixel at the point, in
            world units.
        """
        cameras = self.cameras.select([view])
        pixels, depth = (values[0] for values in cameras.project(points))
        size = torch.tensor([cameras.width, cameras.height])
        outside = torch.linalg.vector_norm(pixels - pixels.clamp(torch.zeros(2), size), dim=-1)
        grid = (2 * pixels / size - 1).nan_to_num(0.0)[None, None]
        distance = F.grid_sample(
            self.distances[view][None, None], grid, align_corners=False, padding_mode="border"
        ).flatten()
        visible = depth > 1e-6 * depth.abs().max().clamp(min=1e-12)
        unknown = ~visible | ((outside > 0) & self.cut[view])
        distance = torch.where(outside > 0, distance.clamp(max=0) - outside, distance)
        width = depth / (0.5 * (cameras.fx + cameras.fy))
        return torch.where(unknown, torch.inf, distance), width

    def carve(self, points: Float[Tensor, "points 3"], wrong_masks: int = 0) -> Float[Tensor, " points"]:
        """Compute an approximate signed distance to the visual hull with an exact zero level.

        The value is the maximum over the views of the distance to the cone of the silhouette, or the
        (wrong_masks + 1)-th largest value if so many views may be wrong about any point. Points that fewer than two or
        wrong_masks + 1 views see are outside.

        Returns:
            Distances in world units, negative inside.
        """
        largest = torch.full((wrong_masks + 1, len(points)), -torch.inf)
        num_seen = torch.zeros(len(points), dtype=torch.int32)
        for view in range(len(self)):
            inside, width = self.depth_inside(view, points)
            is_seen = inside < torch.inf
            num_seen += is_seen
            value = torch.where(is_seen, -inside * width, -torch.inf)
            for rank in range(wrong_masks + 1):
                largest[rank], value = torch.maximum(largest[rank], value), torch.minimum(largest[rank], value)
        outside, unseen = largest[0].abs(), num_seen == 0
        # Outside by a pixel, so that finer levels of the grid examine the border of the seen space.
        outside[unseen] = self._pixel_width(points[unseen])
        return torch.where(num_seen < max(2, wrong_masks + 1), outside, largest[-1])

    def _pixel_width(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Return the smallest width of a pixel of any view at the distance of each point, in world units."""
        width = torch.full_like(points[:, 0], torch.inf)
        for centre, focal_length in zip(self.cameras.camera_to_world[..., 3], self.cameras.fx, strict=True):
            width = torch.minimum(width, (points - centre).norm(dim=-1) / focal_length)
        return width


def centre_lines(silhouettes: Silhouettes) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]]:
    """Return origins and unit directions of the rays through the centroids of the masks, none of which may be empty."""
    cameras, inside = silhouettes.cameras, silhouettes.masks > 0.5
    rows, columns = torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5
    count = inside.sum((1, 2))
    row, column = (inside.sum(2) * rows).sum(1) / count, (inside.sum(1) * columns).sum(1) / count
    rays = cameras.rays(torch.arange(len(cameras)), row - 0.5, column - 0.5)
    return rays.origins.double().numpy(), rays.directions.double().numpy()


def find_box(silhouettes: Silhouettes, wrong_masks: int = 0) -> Float[np.ndarray, "2 3"]:
    """Estimate a cube that contains the object.

    The centre is the point nearest to the rays through the centroids of the masks. The side follows from the widest
    mask, after the `wrong_masks` widest ones are ignored. No mask may be empty.
    """
    cameras, inside = silhouettes.cameras, silhouettes.masks > 0.5
    centre = nearest_point(*centre_lines(silhouettes))
    pixels, depth = cameras.project(torch.from_numpy(centre[None]).float())
    radii = []
    for view in range(len(cameras)):
        height, width = inside[view].any(1).nonzero(), inside[view].any(0).nonzero()
        corners = torch.tensor([[width.min(), height.min()], [width.max() + 1, height.max() + 1]])
        reach = (corners - pixels[view, 0]).abs().amax()
        radii.append(float(reach * depth[view, 0].abs() / (0.5 * (cameras.fx[view] + cameras.fy[view]))))
    half_side = 1.1 * sorted(radii)[-1 - min(wrong_masks, len(radii) - 1)]
    return np.stack([centre - half_side, centre + half_side])


def carve_grid(
    silhouettes: Silhouettes,
    box: Float[np.ndarray, "2 3"],
    resolution: int,
    wrong_masks: int = 0,
    progress: Callable[[float], None] = lambda done: None,
    settings: HullSettings = HullSettings(),
) -> tuple[Float[np.ndarray, "X Y Z"], float]:
    """Evaluate the visual hull on a grid, coarse to fine near the surface.

    Args:
        silhouettes: silhouettes of the object.
        box: corners of the grid; the upper corner moves outwards to an integer number of voxels.
        resolution: number of voxels along the longest side.
        wrong_masks: number of views that may be wrong about any point.
        progress: called with the completed fraction.
        settings: settings of the refinement.

    Returns:
        Signed distances at the corners of the voxels (see `Silhouettes.carve`), and the voxel size in world units.
    """
    settings.use()
    extent, levels = np.asarray(box[1] - box[0], np.float64), settings.levels
    factor = 2**levels
    spacing = float(extent.max()) / (resolution // factor * factor)
    cells = np.ceil(np.round(extent / (factor * spacing), 6)).astype(int).clip(1)
    values = torch.empty(0)
    for level in range(levels + 1):
        step = spacing * 2 ** (levels - level)
        axes = [torch.from_numpy(box[0][a] + step * np.arange(cells[a] * 2**level + 1)).float() for a in range(3)]
        shape = [len(axis) for axis in axes]
        if level == 0:
            values, near = torch.empty(shape), torch.ones(shape, dtype=torch.bool)
        else:
            values = F.interpolate(values[None, None], shape, mode="trilinear", align_corners=True)[0, 0]
            near = values.abs() < settings.band * 2 * step
        index = near.nonzero(as_tuple=True)
        wanted = torch.stack([axis[i] for axis, i in zip(axes, index, strict=True)], -1)
        carved = torch.empty(len(wanted))
        for start in range(0, len(wanted), settings.chunk):
            end = start + settings.chunk
            carved[start:end] = silhouettes.carve(wanted[start:end], wrong_masks)
            progress((level + min(end, len(wanted)) / len(wanted)) / (levels + 1))
        values[near] = carved
    return values.numpy(), spacing


def carve_mesh(
    silhouettes: Silhouettes, box: Float[np.ndarray, "2 3"], resolution: int, wrong_masks: int = 0
) -> TriangleMesh | None:
    """Carve the visual hull without small components (see `carve_grid`); None if the hull is empty."""
    distances, spacing = carve_grid(silhouettes, box, resolution, wrong_masks)
    remove_strays(distances)
    return extract_surface(distances, box[0], spacing) if (distances < 0).any() else None


def remove_strays(
    distances: Float[np.ndarray, "X Y Z"], keep: int | None = None, min_volume: float = 0.02
) -> tuple[int, int]:
    """Remove small components and fill enclosed voids, in place.

    Silhouettes cannot show voids, and the cones of few views also intersect in empty places.

    Args:
        distances: signed distances, negative inside.
        keep: number of largest components to keep; None keeps all of at least `min_volume`.
        min_volume: smallest volume of a component, as a fraction of the volume of the largest one.

    Returns:
        Number of components before and after the removal.
    """
    inside = distances < 0
    voids = scipy.ndimage.binary_fill_holes(inside) & ~inside
    distances[voids] = -np.abs(distances[voids]) - 1e-6
    parts, num_parts = scipy.ndimage.label(distances < 0)
    if num_parts == 0:
        return 0, 0
    sizes = np.bincount(parts.ravel())[1:]
    order = np.argsort(-sizes, kind="stable")
    num_kept = int((sizes >= min_volume * sizes.max()).sum()) if keep is None else min(keep, num_parts)
    strays = ~np.isin(parts, [0, *(order[:num_kept] + 1)])
    distances[strays] = np.abs(distances[strays])
    return num_parts, num_kept


def require_hull(distances: Float[np.ndarray, "X Y Z"]) -> None:
    """Refuse an empty visual hull."""
    if not (distances < 0).any():
        raise NerfroError("the visual hull is empty: no point is inside all masks; check masks and poses")


def extract_surface(
    distances: Float[np.ndarray, "X Y Z"], corner: Float[np.ndarray, "3"], spacing: float
) -> TriangleMesh:
    """Extract the zero level as a mesh in world units, which is closed at the border of the grid.

    Args:
        distances: signed distances, negative inside.
        corner: lower corner of the grid.
        spacing: size of the voxels.

    Raises:
        NerfroError: no voxel is inside.
    """
    require_hull(distances)
    padded = np.pad(distances, 1, constant_values=0.5 * spacing)
    vertices, faces, _, _ = measure.marching_cubes(padded, 0.0, spacing=3 * (spacing,), gradient_direction="descent")
    return merge_vertices(vertices.astype(np.float64) + corner - spacing, faces.astype(np.int64))


def reaches_border(distances: Float[np.ndarray, "X Y Z"]) -> bool:
    """Test whether the body touches a side of the grid."""
    inside = distances < 0
    return bool(inside.sum() > inside[1:-1, 1:-1, 1:-1].sum())
