"""From photographs and a first surface to a refined one: stages, held-back pixels, progress, and going on later."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from nerfro.capture.learned_distance import LearnedDistance
from nerfro.capture.surface_refinement import OutlinePixels, Stage, refine, seen_error
from nerfro.capture.surroundings import Pixels, divide_pixels, learn_surroundings
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.files.cache import content_hash, load_arrays, save_arrays
from nerfro.files.drawing import magma, sheet
from nerfro.files.images import save_picture
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.sdf_grid import SdfGrid

# What was learned so far, until it is done; and how much of the photographs was and is explained.
UNFINISHED, ERRORS = "refinement.npz", "refinement.png"
# Photographs' largest side in pixels, steps and events of paths, stage by stage.
_STAGES = ((64, 150, 2), (128, 250, 4))
_EVERY = 25  # steps between two looks at the held-back pixels
_PATIENCE = 5  # looks without gain before a stage ends
_HELD_BACK, _JUDGED = 10, 8000  # every so many-th pixel is held back, so many of them are looked at
_SHOWN = 6  # views in the picture of errors


def refine_mesh(
    views: Views, mesh: TriangleMesh, silhouettes: Silhouettes, ior: float, room: bool | None, resolution: int,
    folder: Path,
) -> TriangleMesh:  # fmt: skip
    """Refine a surface from what is seen through it.

    Interrupted, it goes on from the file `refinement.npz` in the folder, which is gone when it is done.

    Args:
        views: photographs.
        mesh: the surface to begin with.
        silhouettes: outlines that it keeps.
        ior: refractive index inside.
        room: whether the surroundings are near; None finds out.
        resolution: voxels along the surface's longest side.
        folder: to keep what was learned in.

    Returns:
        The surface.
    """
    distance = LearnedDistance(mesh, resolution)
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    ) as progress:
        stages, judged = [], None
        learning = progress.add_task("surroundings", total=len(_STAGES))
        for number, (side, steps, max_events) in enumerate(_STAGES):
            beside, through = divide_pixels(views, mesh, side)
            surroundings = learn_surroundings(
                beside, mesh, room, lambda done, n=number: progress.update(learning, completed=n + done)
            )
            held_back = through.index % _HELD_BACK == 0
            stages.append(Stage(through[~held_back], surroundings, steps, max_events))
            judged = through[held_back].some(_JUDGED)
        assert judged is not None
        judge = _Judge(distance, stages[-1], judged, ior, folder / UNFINISHED, content_hash(mesh.vertices, ior))
        refining = progress.add_task("surface", total=sum(stage.steps for stage in stages))
        outlines = OutlinePixels(silhouettes)

        def after(step: int) -> bool:
            progress.update(refining, completed=step)
            return judge(step)

        refine(distance, stages, outlines, ior, after, judge.step)
    before = distance.medium([ior], torch.zeros_like(distance.given))
    judge.take_best()
    with torch.no_grad():
        after_all = distance.medium([ior], distance.offset())
        save_picture(folder / ERRORS, _errors_of_views(before, after_all, through, stages[-1]))
    (folder / UNFINISHED).unlink(missing_ok=True)
    print(f"error of held-back pixels: {judge.errors[0]:.4f} before, {min(judge.errors):.4f} after {judge.step} steps")
    return distance.mesh()


def _errors_of_views(before: SdfGrid, after: SdfGrid, through: Pixels, stage: Stage) -> Image.Image:
    """Some views' robust errors with both surfaces; grey where no ray is compared."""
    cameras = through.cameras
    pictures, captions = [], []
    for view in np.linspace(0, len(cameras) - 1, min(_SHOWN, len(cameras))).astype(int).tolist():
        pixels = through[through.view == view]
        first = view * cameras.height * cameras.width
        for medium, when in ((before, "before"), (after, "after")):
            error, used = seen_error(medium, pixels, stage, learn=False)
            picture = torch.full((cameras.height * cameras.width,), torch.nan)
            picture[pixels.index[used] - first] = error
            pictures.append(magma(picture.view(cameras.height, cameras.width), 1.0))
            captions.append(f"view {view}, {when}: {float(error.mean()):.3f}")
    return sheet(pictures, captions, 256, 4, "robust error of what is seen through the surface, 0 (black) to 1")


class _Judge:
    """Looks at held-back pixels now and then, keeps the best surface on disk, and says when it no longer pays."""

    def __init__(
        self, distance: LearnedDistance, stage: Stage, pixels: Pixels, ior: float, file: Path, key: str
    ) -> None:
        self._distance, self._stage, self._pixels, self._ior = distance, stage, pixels, ior
        self._file, self._key = file, key
        self.step, self.errors = 0, [self._error()]
        self._best = self._grids()
        if file.is_file():
            self._resume()

    def __call__(self, step: int) -> bool:
        """Whether it pays to go on after so many steps."""
        self.step = step
        if step % _EVERY:
            return True
        self.errors.append(self._error())
        if self.errors[-1] <= min(self.errors):
            self._best = self._grids()
        grids = {f"now_{i}": grid.numpy() for i, grid in enumerate(self._grids())}
        grids |= {f"best_{i}": grid.numpy() for i, grid in enumerate(self._best)}
        facts = {"key": np.array(self._key), "step": np.array(step), "errors": np.array(self.errors)}
        save_arrays(self._file, grids | facts)
        latest = self.errors[-_PATIENCE:]
        return len(self.errors) <= _PATIENCE or min(latest) < min(self.errors[:-_PATIENCE])

    def take_best(self) -> None:
        """Let the distance be the best that was seen."""
        self._take(self._best)

    @torch.no_grad()
    def _error(self) -> float:
        medium = self._distance.medium([self._ior], self._distance.offset())
        error, used = seen_error(medium, self._pixels, self._stage, learn=False)
        # Where nothing is known, as much as unrelated colours: no surface is better for hiding its light.
        return float((error.sum() + (~used).sum()) / len(used))

    def _grids(self) -> list[Tensor]:
        return [grid.detach().clone() for grid in self._distance.offsets]

    def _take(self, grids: list[Tensor]) -> None:
        with torch.no_grad():
            for grid, value in zip(self._distance.offsets, grids, strict=True):
                grid.copy_(value)

    def _resume(self) -> None:
        known = load_arrays(self._file)
        if str(known.get("key")) != self._key:
            return  # of another surface or index
        count = len(self._best)
        self._best = [torch.from_numpy(known[f"best_{i}"]) for i in range(count)]
        self._take([torch.from_numpy(known[f"now_{i}"]) for i in range(count)])
        self.step, self.errors = int(known["step"]), known["errors"].tolist()
        print(f"goes on after {self.step} steps, from {self._file}")
