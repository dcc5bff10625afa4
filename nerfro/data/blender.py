"""Data format of the synthetic NeRF scenes (Blender)."""

from __future__ import annotations

from nerfro.allowed import Distance, Factor
from nerfro.data.frames import FrameSet, PosedImages
from nerfro.data.image_files import Alpha
from nerfro.data.transforms import find_splits, read_manifest
from nerfro.registry import register


@register("data", "blender")
class BlenderData(PosedImages):
    """Read the Blender format of the synthetic NeRF scenes: `transforms_{train,val,test}.json`.

    Poses have OpenGL camera axes; `read_lens` describes the keys of the lens. `embedded:torus` is the scene that is
    distributed with nerfro. `PosedImages` describes the options.
    """

    def __init__(
        self,
        root: str = "embedded:torus",
        near: Distance = 2.0,
        far: Distance = 6.0,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        mask_labels: list[int] | None = None,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha, mask_labels)

    @property
    def splits(self) -> list[str]:
        return list(find_splits(self.root))

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        return FrameSet(manifest.frames, manifest.lenses(), "opengl")
