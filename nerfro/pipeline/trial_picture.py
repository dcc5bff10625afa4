"""Picture of the trials of all hypotheses beside validation photographs: crops around the object, with scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import crop_rectangle, object_pixels
from nerfro.evaluation.results import EXPOSED, FULL, Region
from nerfro.files.images import load_png, sheet
from nerfro.pipeline.trials import Trial
from nerfro.training.config import build_data
from nerfro.training.run_folder import run_config

PICTURE = "hypotheses.png"
_NUM_VIEWS, _MIN_WIDTH = 3, 256  # photographs, and the width in pixels that the captions need
_Window = tuple[slice, slice]


def validation_views(folder: Path) -> Views:
    """Read the photographs on which a trial was scored, and their masks."""
    config = run_config(folder)
    return build_data(config).load(str(config.evaluation.split))


def draw_trials(trials: Sequence[Trial], views: Views) -> Image.Image:
    """Draw three photographs and their images by every hypothesis in columns, with mean scores below.

    Args:
        trials: the trials, in the order of the columns.
        views: the photographs on which they were scored.

    Raises:
        NerfroError: an image of a trial is missing, or has another size than the photographs.
    """
    names = [view.name for view in trials[0].result.views]
    windows = _windows(views, len(names))
    images, captions = list[Tensor](), list[str]()
    for view, window in windows.items():
        images.append(views.images[view][window])
        captions.append(f"photograph {views.names[view]}")
        images += [_image(trial, names[view], views.images[view].shape)[window] for trial in trials]
        captions += [trial.hypothesis.name for trial in trials]
    last = len(captions) - len(trials)
    captions[last:] = [f"{trial.hypothesis.name}\n{_scores(trial)}" for trial in trials]
    width = -(-_MIN_WIDTH // images[0].shape[1]) * images[0].shape[1]
    fitted = ", exposures fitted" if trials[0].has_fitted_exposures else ""
    title = f"hypotheses about the object, and their mean scores on {len(names)} validation photographs{fitted}"
    return sheet(images, captions, width, len(trials) + 1, title)


def _windows(views: Views, num_scored: int) -> dict[int, _Window]:
    """Return windows of equal size around the object in evenly spread views that show it; whole views without masks."""
    height, width = views.cameras.height, views.cameras.width
    crops = dict.fromkeys(range(num_scored), (slice(0, height), slice(0, width)))
    if views.masks is not None:
        inside = {view: object_pixels(views.masks[view]) for view in crops}
        crops = {view: crop_rectangle(mask) for view, mask in inside.items() if mask.any()} or crops
    spread = np.linspace(0, len(crops) - 1, min(_NUM_VIEWS, len(crops))).round().astype(int)
    crops = {list(crops)[number]: list(crops.values())[number] for number in spread}
    rows, columns = (max(crop[axis].stop - crop[axis].start for crop in crops.values()) for axis in (0, 1))
    return {view: (_widened(crop[0], rows, height), _widened(crop[1], columns, width)) for view, crop in crops.items()}


def _widened(extent: slice, size: int, limit: int) -> slice:
    """Return `size` pixels around the centre of an extent, shifted into the image."""
    start = min(max((extent.start + extent.stop - size) // 2, 0), limit - size)
    return slice(start, start + size)


def _image(trial: Trial, name: str, shape: Sequence[int]) -> Float[Tensor, "H W 3"]:
    folder = trial.run.folder / (f"images_{EXPOSED}" if trial.has_fitted_exposures else "images")
    image = load_png(folder / f"{name}.png")
    if image.shape != tuple(shape):
        raise NerfroError(
            f"{folder / name}.png is {list(image.shape[:2])} pixels high and wide, but the photographs of the first "
            f"trial are {list(shape[:2])}; delete {trial.run.folder.parent} and repeat this command"
        )
    return image


def _scores(trial: Trial) -> str:
    regions: dict[str, Region] = {"image": FULL, "crop": "crop"}
    return "\n".join(
        f"{label}: PSNR {trial.shown('psnr', region)} dB, LPIPS {trial.shown('lpips', region)}"
        for label, region in regions.items()
    )
