"""Interface of a data format: `DataSource` loads the `Views` of one split.

`WithValidationViews` takes the validation views of any data set from its training views.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.progress import track
from nerfro.core.types import WORLD_ORIGIN
from nerfro.data.lazy_images import LazyImages

SPLITS = ["train", "val", "test"]


@dataclass(frozen=True)
class Frame:
    """One posed image of a data set.

    Attributes:
        name: the image's name in the data set.
        image: file of the image.
        mask: file of the silhouette of the refractive object, or None.
        camera_to_world: rotation and centre in world units. The data format defines the camera axes.
    """

    name: str
    image: Path
    mask: Path | None
    camera_to_world: Float[np.ndarray, "3 4"]


@dataclass(frozen=True)
class Views:
    """Posed images of one split.

    Images, masks and usable pixels are indexed by view. Each is a tensor, or `LazyImages`, which decode a file on
    access. `torch.stack(list(views.images))` is a tensor in both cases.

    Attributes:
        cameras: one camera per image; all images have the same resolution.
        images: RGB colours [H, W, 3], sRGB in [0, 1], which continues beyond 1 for photographs in linear light.
        masks: coverage of each pixel [H, W] by the refractive object in [0, 1], or None if the data set has no masks.
        names: names of the images in the data set.
        usable: pixels [H, W] that training may use (1 or True), or None if all pixels are usable.
        maps: further values of each pixel by name, in the resolution of the images, which losses find in `batch.maps`
            and metrics in `ViewMaps.data`.
            The map `depth` has one channel: the arc length of the ray through the pixel, world units; 0 if unknown.
        frames: image and mask files, if the data format knows them; otherwise empty.
        mask_labels: labels of the object in the mask files, see `nerfro.data.image_files.read_mask`.

    Raises:
        NerfroError: images, masks or usable pixels are neither a tensor nor `LazyImages`.
    """

    cameras: Cameras
    images: LazyImages | Float[Tensor, "V H W 3"]
    masks: LazyImages | Float[Tensor, "V H W"] | None
    names: list[str]
    usable: LazyImages | Bool[Tensor, "V H W"] | None = None
    maps: Mapping[str, Float[Tensor, "V H W _"]] = field(default_factory=dict)
    frames: Sequence[Frame] = ()
    mask_labels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        for name in ("images", "masks", "usable"):
            value = getattr(self, name)
            if not isinstance(value, (Tensor, LazyImages)) and (value is not None or name == "images"):
                raise NerfroError(
                    f"Views.{name} is a {type(value).__name__}; give one tensor of all views, as by torch.stack, or "
                    "LazyImages"
                )
        size = len(self.names), self.cameras.height, self.cameras.width
        for name, values in self.maps.items():
            if tuple(values.shape[:3]) != size or values.ndim != 4:
                raise NerfroError(f"Views.maps['{name}'] has the shape {list(values.shape)}; give {[*size, 'C']}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def in_linear_light(self) -> bool:
        """Whether the photographs are in linear light (.exr, .hdr, TIFF in floating point, raw), and may exceed 1."""
        images = self.images
        return images.dtype == np.float32 if isinstance(images, LazyImages) else bool((images > 1).any())

    def refuse_linear_light(self, component: str) -> None:
        """Refuse photographs in linear light for a component whose radiance is at most 1."""
        if self.in_linear_light:
            raise NerfroError(
                f"the photographs are in linear light and may exceed 1, but the radiance of {component} may not; take "
                "model.colour=hdr field=hash_grid background=envmap, or convert the photographs to PNG"
            )

    def select(self, views: Sequence[int]) -> Views:
        """Return the views with the given indices, in this order."""
        indices = list(views)
        values = {name: getattr(self, name) for name in ("images", "masks", "usable")}
        images: dict[str, Any] = {
            name: p.select(indices) if isinstance(p, LazyImages) else p for name, p in values.items()
        }
        images = {name: p[indices] if isinstance(p, Tensor) else p for name, p in images.items()}
        names, frames = [self.names[view] for view in indices], [self.frames[view] for view in indices if self.frames]
        images["maps"] = {name: values[indices] for name, values in self.maps.items()}
        return replace(self, cameras=self.cameras.select(indices), names=names, frames=frames, **images)

    def joined(self, other: Views) -> Views | None:
        """Append other views; None unless all image and mask files have one size.

        The result has neither masks of usable pixels nor maps.
        """
        parts = self.images, other.images, self.masks, other.masks
        if not all(isinstance(part, LazyImages) for part in parts) or self.images.shape != other.images.shape:
            return None
        images, more_images, masks, more_masks = cast(tuple[LazyImages, ...], parts)
        return replace(
            self,
            cameras=Cameras.joined([self.cameras, other.cameras]),
            images=images.joined(more_images),
            masks=masks.joined(more_masks),
            names=[*self.names, *other.names],
            frames=[*self.frames, *other.frames],
            usable=None,
            maps={},
        )

    def spread(self, most: int) -> list[int]:
        """Return the indices of up to `most` evenly spread views, in ascending order."""
        return np.unique(np.linspace(0, len(self) - 1, most).round().astype(int)).tolist()

    def checked(self) -> Views:
        """Decode every image and mask once, without storing it, warn of useless masks, and return these views.

        Raises:
            NerfroError: a file is corrupt.
        """
        if isinstance(self.images, LazyImages):
            deque(track("reading", self.images.all_levels(), len(self.images)), maxlen=0)
        if isinstance(self.masks, LazyImages):
            middle, masks = np.iinfo(self.masks.dtype).max // 2, self.masks.all_levels()
            ends = [(mask.max() <= middle, mask.min() > middle) for mask in track("reading", masks, len(self.masks))]
            for state, wrong in zip(("empty", "full"), np.transpose(ends), strict=True):
                if wrong.any():
                    names = first_of([self.names[view] for view in np.flatnonzero(wrong)])
                    warn(
                        f"{wrong.sum()} of {len(self)} masks are {state} ({names}); draw the object white and "
                        "everything else black, or choose its labels with data.mask_labels"
                    )
        return self


class DataSource(ABC):
    """A data set on disk in one format. Derive from this class to add a format.

    Attributes:
        root: folder of the data set.
        mask_labels: labels of the object in the mask files, see `nerfro.data.image_files.read_mask`.
        origin: world coordinates of the origin of the positions in `Views`; see `Medium.origin`.
    """

    root: Path
    mask_labels: Sequence[int] | None = None
    origin: Float[np.ndarray, "3"] = WORLD_ORIGIN

    def with_origin(self, origin: Float[np.ndarray, "3"]) -> DataSource:
        """Return the same data set with positions relative to another origin, world coordinates."""
        moved = copy.copy(self)
        moved.origin = origin
        return moved

    def cameras_of(self, file: Path) -> Cameras | None:
        """Return the cameras that a file of the data set states, as `load` does; None for any other file."""
        return None

    @property
    @abstractmethod
    def splits(self) -> list[str]:
        """Names of the splits in the data set."""

    @abstractmethod
    def load(self, split: str) -> Views:
        """Load one split.

        Poses, intrinsics and file headers are checked here. Pixels may be decoded later; see `Views.checked`.

        Args:
            split: one of `splits`.

        Returns:
            The views, with OpenGL camera axes (x right, y up, viewing direction -z), lengths in world units, and
            positions relative to `origin`.

        Raises:
            NerfroError: the split is unknown, a file is missing or has the wrong size, or a number is not finite.
        """


class WithValidationViews(DataSource):
    """Use some training views of a data set as its `val` split instead.

    Args:
        source: the data set.
        number: number of validation views; `spread` distributes these over the camera positions.
    """

    def __init__(self, source: DataSource, number: int) -> None:
        self._source, self._number = source, number
        self.root, self.origin = source.root, source.origin

    def cameras_of(self, file: Path) -> Cameras | None:
        return self._source.cameras_of(file)

    @property
    def splits(self) -> list[str]:
        names = self._source.splits
        return names if "val" in names else [*names, "val"]

    def load(self, split: str) -> Views:
        if split not in ("train", "val"):
            return self._source.load(split)
        views = self._source.load("train")
        num_training = len(views) - self._number
        if num_training < 1:
            raise NerfroError(
                f"batches.num_validation_views={self._number} leaves no view to train on: "
                f"there are {len(views)} training views; "
                f"take at most {len(views) - 1}"
            )
        positions = views.cameras.camera_to_world[:, :, 3].double().cpu().numpy()
        # The smaller group is the spread one; the views that remain are then distributed as well.
        spread_views = spread(positions, min(self._number, num_training))
        others = [view for view in range(len(views)) if view not in spread_views]
        return views.select(spread_views if (split == "val") == (self._number <= num_training) else others)


def spread(positions: Float[np.ndarray, "V 3"], number: int) -> list[int]:
    """Select positions so that every other position is close to a selected one (greedy k-medians).

    Each step adds the position that reduces the sum of distances to the nearest selected position most. The outermost
    positions are rarely selected, which is intended: no other training view could replace an outermost one.

    Returns:
        Indices of the selected positions, ascending.
    """
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    nearest, selected = np.full(len(positions), np.inf), np.zeros(len(positions), bool)
    for _ in range(number):
        sums = np.minimum(distances, nearest).sum(-1)
        best = int(np.where(selected, np.inf, sums).argmin())
        selected[best], nearest = True, np.minimum(nearest, distances[best])
    return np.flatnonzero(selected).tolist()
