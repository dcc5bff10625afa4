"""Decision between hypotheses about an object by the scores of their trials on validation photographs.

A picture shows the trials of all hypotheses beside the photographs: crops around the object, with scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerfro.capture.object_errors import STRAIGHT
from nerfro.cli.overrides import command_line, not_given
from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import crop_rectangle, image_metrics, object_pixels
from nerfro.evaluation.perceptual import MIN_SIZE
from nerfro.evaluation.results import EXPOSED, FULL, OBJECT, EvaluationResult, Region, RunMetrics, Score
from nerfro.evaluation.tables import MISSING
from nerfro.files.images import load_png, sheet
from nerfro.pipeline.hypotheses import Hypothesis
from nerfro.training.config import build_data
from nerfro.training.run import Run
from nerfro.training.run_folder import run_config


@dataclass(frozen=True)
class DecisionSettings(AlgorithmSettings):
    """Settings of the decision between straight and bent rays (`preferred`).

    On a simulated empty glass, a gain of 0.33 dB in the trial became a gain of 0.75 dB after four minutes
    (docs/lab/simulated_glassware.md). On a real empty glass, bent rays lost 0.9 dB of the image and had the lower LPIPS
    (docs/lab/hypotheses.md). PSNR prefers blur to sharp edges in slightly wrong positions, and LPIPS prefers the edges.

    Attributes:
        min_gain: smallest gain of bent rays in the mean PSNR of image and object, in dB, because scores of five
            photographs vary.
        max_loss: largest loss of bent rays in the PSNR of the image, in dB, if their LPIPS of the crop around the
            object is lower than that of straight rays.
    """

    min_gain: float = 0.25
    max_loss: float = 1.0


@dataclass(frozen=True)
class Trial:
    """A hypothesis and its short training.

    Attributes:
        hypothesis: the hypothesis.
        run: the training, which is scored on validation photographs.
    """

    hypothesis: Hypothesis
    run: Run

    @property
    def metrics(self) -> RunMetrics:
        """All scores of the validation photographs."""
        assert self.run.scores is not None
        return self.run.scores

    @property
    def has_fitted_exposures(self) -> bool:
        """Whether scores belong to right halves with fitted exposures, unless a right half lacks the object."""
        return EXPOSED in self.metrics.treatments and self.metrics.treatments[EXPOSED].mean("psnr", OBJECT) is not None

    @property
    def result(self) -> EvaluationResult:
        """Scores that are compared; the exposures of validation photographs are unknown."""
        return self.metrics.treatments[EXPOSED] if self.has_fitted_exposures else self.metrics.result

    def score(self, metric: str, region: Region = FULL) -> Score:
        """Average a score over the photographs; of whole photographs where right halves are too small for it."""
        score = self.result.mean(metric, region)
        return self.metrics.result.mean(metric, region) if score is None else score

    def shown(self, metric: str, region: Region = FULL) -> str:
        """Format a score for a table."""
        score = self.score(metric, region)
        return MISSING if score is None else f"{score:.{image_metrics()[metric].decimals}f}"

    @property
    def image(self) -> float:
        """PSNR of the image in dB."""
        return self.score("psnr") or 0.0

    @property
    def mean(self) -> float:
        """Mean PSNR of image and object in dB, or that of the image if there is no mask."""
        inside = self.score("psnr", OBJECT)
        return self.image if inside is None else 0.5 * (self.image + inside)

    @property
    def lpips(self) -> Score:
        """LPIPS of the crop around the object; None without masks or for small crops."""
        return self.score("lpips", "crop")

    @property
    def figures(self) -> str:
        """Name and scores in words."""
        psnr = f"{self.hypothesis.name} {self.shown('psnr')} dB (object {self.shown('psnr', OBJECT)} dB)"
        return f"{psnr}, LPIPS of the crop {self.shown('lpips', 'crop')}"


def preferred(trials: Sequence[Trial], settings: DecisionSettings = DecisionSettings()) -> tuple[Trial, Trial | None]:
    """Decide by PSNR of image and object, and by LPIPS of the crop around the object.

    Bent rays are preferred if they gain PSNR. Otherwise, they are preferred if their LPIPS is lower than that of
    straight rays and the loss in PSNR of the image is small. Without LPIPS, PSNR alone decides.

    Args:
        trials: trials of the hypotheses, straight rays first.
        settings: limits of gain and loss.

    Returns:
        The preferred trial, and the trial that is better by the other score; None if both scores agree.
    """
    settings.use()
    straight, *bent = trials
    highest = max(bent, key=lambda trial: trial.mean)
    by_psnr = highest if highest.mean >= straight.mean + settings.min_gain else straight
    lpips = {trial.hypothesis.name: trial.lpips for trial in trials if trial.lpips is not None}
    if len(lpips) < len(trials):
        return by_psnr, None

    def distance(trial: Trial) -> float:
        return lpips[trial.hypothesis.name]

    similar = [
        trial
        for trial in bent
        if distance(trial) < distance(straight) and trial.image >= straight.image - settings.max_loss
    ]
    best = min(similar, key=distance) if by_psnr is straight and similar else by_psnr
    other = min(trials, key=distance) if best is by_psnr else by_psnr
    return best, None if other is best else other


def decide(trials: Sequence[Trial], overrides: Sequence[str]) -> Trial:
    """Print the scores of the trials and the decision, and return the preferred trial.

    Args:
        trials: at least two trials, straight rays first; without straight rays, the highest PSNR decides.
        overrides: the command line, for the command that continues with another hypothesis.
    """
    print("\nscores of short trainings on validation photographs, PSNR in dB and LPIPS of the crop around the object:")
    print(f"  {'hypothesis':<20}{'image':>9}{'object':>9}{'mean':>9}{'LPIPS':>9}")
    for trial in trials:
        image, inside, lpips = trial.shown("psnr"), trial.shown("psnr", OBJECT), trial.shown("lpips", "crop")
        print(f"  {trial.hypothesis.name:<20}{image:>9}{inside:>9}{trial.mean:>9.2f}{lpips:>9}")
    if trials[0].hypothesis.name != STRAIGHT:
        best = max(trials, key=lambda trial: trial.mean)
        print(f"training continues with: {best.hypothesis.name}")
        return best
    settings = DecisionSettings()
    best, other = preferred(trials, settings)
    print(f"training continues with: {best.hypothesis.name}")
    if any(trial.lpips is None for trial in trials):
        small = f"a crop is smaller than {MIN_SIZE} pixels"
        reason = small if trials[0].score("psnr", OBJECT) is not None else "a photograph has no mask of the object"
        print(f"PSNR alone decides, because LPIPS of the crop is not available: {reason}")
    if best is trials[0]:
        print(_why_straight(trials, settings))
    gain = best.mean - trials[0].mean
    if best is not trials[0] and gain < settings.min_gain:
        print(
            f"LPIPS decides, because the mean PSNR of bent rays is not higher by {settings.min_gain} dB: {gain:+.2f} dB"
        )
    if other is not None:
        print(f"PSNR and LPIPS disagree: {best.figures}; {other.figures}; to continue with {other.hypothesis.name}:")
        choice = [f"hypothesis={other.hypothesis.choice}"]
        print(f"  {command_line('reconstruct', [*not_given(overrides, choice), *choice])}")
    return best


def _why_straight(trials: Sequence[Trial], settings: DecisionSettings) -> str:
    """Return the reason for straight rays, and the options for bent rays."""
    doubts = [trial.hypothesis.doubt for trial in trials if trial.hypothesis.doubt]
    reason = doubts[0] if doubts else "the surface or the index is not accurate enough, or the object is opaque"
    options = " or ".join(dict.fromkeys(f"hypothesis={trial.hypothesis.choice}" for trial in trials[1:]))
    without_lpips = any(trial.lpips is None for trial in trials)
    similar = "" if without_lpips else f", and their LPIPS is not lower at a loss of at most {settings.max_loss} dB"
    return (
        f"the mean of bent rays is not higher by {settings.min_gain} dB{similar}: {reason}; to use bent rays "
        f"nevertheless, add {options}"
    )


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
