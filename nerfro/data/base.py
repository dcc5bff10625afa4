"""What a data set is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.data.pictures import Pictures
from nerfro.progress import told


@dataclass(frozen=True)
class Frame:
    """One posed image and its silhouette; its name and its camera's axes are those of the data set."""

    name: str
    image: Path
    mask: Path | None
    camera_to_world: Float[np.ndarray, "3 4"]


@dataclass(frozen=True)
class Views:
    """Posed images of one split. `images[i]`, `masks[i]` and `usable[i]` are tensors, mostly read when asked for.

    Attributes:
        cameras: one camera for each image, all of one resolution.
        images: colours [H, W, 3], sRGB in [0, 1].
        masks: share [H, W] of each pixel that the refractive object covers, or None where the data has no masks.
        names: of the images, as the data set calls them.
        usable: 1 (or True) in the pixels [H, W] that may be trained on, or None for all of them.
        frames: files of the images and their masks, where the loader knows them.
    """

    cameras: Cameras
    images: Pictures | Float[Tensor, "V H W 3"]
    masks: Pictures | Float[Tensor, "V H W"] | None
    names: list[str]
    usable: Pictures | Bool[Tensor, "V H W"] | None = None
    frames: Sequence[Frame] = ()

    def __len__(self) -> int:
        return len(self.names)

    def select(self, views: Sequence[int]) -> Views:
        """Some of the views, in the order that is asked for."""
        chosen = list(views)
        given = {name: getattr(self, name) for name in ("images", "masks", "usable")}
        pictures = {name: p.select(chosen) if isinstance(p, Pictures) else p for name, p in given.items()}
        pictures = {name: p[chosen] if isinstance(p, Tensor) else p for name, p in pictures.items()}
        names, frames = [self.names[view] for view in chosen], [self.frames[view] for view in chosen if self.frames]
        return replace(self, cameras=self.cameras.select(chosen), names=names, frames=frames, **pictures)

    def checked(self) -> Views:
        """These views, of which every picture has been decoded once, to refuse what is corrupt, and forgotten."""
        for pictures in (self.images, self.masks):
            if isinstance(pictures, Pictures):
                deque(told("reading", pictures.all_levels(), len(pictures)), maxlen=0)
        return self


class DataSource(ABC):
    """A folder, `root`, of posed images in some format."""

    root: Path

    @property
    @abstractmethod
    def splits(self) -> list[str]:
        """Names of the splits that the folder holds."""

    @abstractmethod
    def load(self, split: str) -> Views:
        """One split, checked but for the pixels of its pictures, which are read later: see `Views.checked`.

        Raises:
            NerfroError: unknown split, or anything missing, of the wrong size or not finite.
        """
