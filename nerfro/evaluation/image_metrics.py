"""Metrics of two images: regions, error maps, the base class of plugins of type `metric`, and the built-in metrics."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from skimage import metrics
from torch import Tensor, nn

from nerfro.core.errors import NerfroError, nearest_of
from nerfro.files.images import magma
from nerfro.registry.registration import CHECKS, create, discover, find, plugins, register


def object_pixels(coverage: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Return the pixels of which the object covers at least half, from the coverage (`Views.masks`)."""
    return coverage >= 0.5


def crop_rectangle(inside: Bool[Tensor, "H W"]) -> tuple[slice, slice]:
    """Return the bounding rectangle of the dilated mask, the region of the paper's scores on real scenes.

    All pixels of the rectangle count. Dilation by a centred box of 35 pixels moves each side of the bounding rectangle
    by 17 pixels, up to the border of the image, so the mask itself is not dilated.

    Args:
        inside: mask of the object, not empty.

    Returns:
        Slices of rows and columns.
    """
    margin = 17
    occupied = [inside.any(1 - axis).nonzero() for axis in (0, 1)]
    first, last = [max(int(i.min()) - margin, 0) for i in occupied], [int(i.max()) + margin + 1 for i in occupied]
    return slice(first[0], min(last[0], inside.shape[0])), slice(first[1], min(last[1], inside.shape[1]))


def require_images(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Shaped[Tensor, "H W"] | None = None
) -> None:
    """Refuse two images, and a mask, that do not fit; a batch of images is not one image.

    Raises:
        NerfroError: the images are not [H, W, 3] of the same size, or the mask is not [H, W].
    """
    if prediction.shape != target.shape or target.ndim != 3 or target.shape[-1] != 3:
        raise NerfroError(
            f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
            "both must have the same size [H, W, 3]"
        )
    if inside is not None and inside.shape != target.shape[:2]:
        raise NerfroError(f"a mask {list(inside.shape)} does not fit an image {list(target.shape)}; give [H, W]")


def mean_over(values: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Average over the pixels of a mask, or over all pixels without a mask; NaN for an empty mask."""
    return values.mean() if inside is None else values[inside].mean()


# Squared error at the end of the colour scale; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05


@dataclass(frozen=True)
class ErrorMap:
    """Error at each pixel of an image.

    Attributes:
        name: name of the metric, as in file names.
        title: title of the colour scale.
        values: error [H, W]; 0 for equal pixels, NaN for pixels without a value.
        limit: value of the last colour of the scale, equal for all images.
    """

    name: str
    title: str
    values: Float[Tensor, "H W"]
    limit: float

    def colours(self) -> Float[Tensor, "H W 3"]:
        """Apply the magma colour map; the result is sRGB in [0, 1]."""
        return magma(self.values, self.limit)


def squared_error_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Compute the squared error of each pixel, averaged over channels. Its mean over the image determines the PSNR."""
    require_images(prediction, target)
    return (prediction - target).square().mean(-1)


def squared_error_colours(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Draw the squared error of each pixel in the colours of a fixed scale."""
    return magma(squared_error_map(prediction, target), SQUARED_ERROR_LIMIT)


def triptych(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H 3*W 3"]:
    """Concatenate prediction, reference and squared error for the training log, on the CPU and without text."""
    error = squared_error_colours(prediction, target)
    return torch.cat([prediction.detach().cpu().float().clamp(0, 1), target.detach().cpu().float(), error], dim=1)


MAX_PSNR = 100.0  # dB; the infinite PSNR of equal images has no mean and no representation in JSON

# Order in tables; other metrics follow.
_FIRST = ("psnr", "ssim", "lpips", "flip")
WINDOW = 11  # pixels of SSIM; Gaussian of sigma 1.5, truncated at 3.5 sigma


def ssim_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """Compute the structural similarity at each pixel and channel whose window lies inside the image, by scikit-image.

    The window is a Gaussian of 11 pixels and sigma 1.5. Covariances are weighted (not unbiased), K = (0.01, 0.03).
    Double precision is used because variances are differences of nearly equal numbers.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].

    Returns:
        Similarity in [-1, 1].

    Raises:
        NerfroError: the image is smaller than the window.

    Source:
        Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004, Eqn. 13 to 16.
    """
    require_images(prediction, target)
    if min(prediction.shape[:2]) < WINDOW:
        raise NerfroError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, got {list(prediction.shape[:2])}; use PSNR")
    _, similarity = metrics.structural_similarity(
        *(image.detach().cpu().double().numpy() for image in (prediction, target)),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    border = WINDOW // 2
    return torch.from_numpy(similarity[border:-border, border:-border]).to(prediction.device)


def ssim(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the structural similarity (SSIM), the mean of `ssim_map`; higher is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        Mean in [-1, 1], without unit; NaN if no pixel of the mask has a window inside the image.
    """
    require_images(prediction, target, inside)
    border = WINDOW // 2
    inside = None if inside is None else inside[border:-border, border:-border]
    return mean_over(ssim_map(prediction, target).mean(-1), inside)


@dataclass(frozen=True)
class ViewMaps:
    """Values of the pixels of one view beside its colours, by name.

    Attributes:
        data: maps of the data set, see `Views.maps`.
        rendered: `depth`, `opacity`, `exit_directions`, `normals` and `refracted` of the model, see `RenderedRays`.
    """

    data: Mapping[str, Float[Tensor, "H W _"]]
    rendered: Mapping[str, Float[Tensor, "H W _"]]

    def __getitem__(self, window: tuple[slice, slice]) -> ViewMaps:
        """Select rows and columns of all maps."""
        data, rendered = (
            {name: values[window] for name, values in maps.items()} for maps in (self.data, self.rendered)
        )
        return ViewMaps(data, rendered)


class ImageMetric(nn.Module, ABC):
    """Score of a rendered image.

    Attributes:
        title: heading in tables; by default, the registered name.
        better: whether higher or lower scores are better.
        decimals: number of decimals in tables.
        min_size: smallest side of an image in pixels; smaller images have no score.
        missing: reason why the metric is not available on this machine, or None.
        maps: names of the maps of the data set that the metric needs; views without them have no score. If there are
            names, `forward` has a fourth parameter, `maps`, of type `ViewMaps`.
    """

    title: ClassVar[str]
    better: ClassVar[Literal["higher", "lower"]]
    decimals: ClassVar[int] = 3
    min_size: int = 1
    missing: str | None = None
    maps: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def forward(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
    ) -> Float[Tensor, ""]:
        """Score one image.

        Args:
            prediction: rendered image, sRGB in [0, 1].
            target: reference image, sRGB in [0, 1].
            inside: mask of the pixels that count; by default, all pixels count.

        Returns:
            Score; NaN if it is not defined, for example for an empty mask.
        """

    def error_map(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> ErrorMap | None:
        """Compute the error of each pixel for sheets of error maps; by default, the metric has no map."""
        return None

    def score(
        self, prediction: Tensor, target: Tensor, inside: Tensor | None = None, maps: ViewMaps | None = None
    ) -> float:
        """Return the score as a number; NaN if the metric or a map is missing, or the image is too small."""
        if self.missing is not None or min(prediction.shape[:2]) < self.min_size:
            return math.nan
        if not self.maps:
            return float(self(prediction, target, inside))
        present = maps is not None and all(name in maps.data for name in self.maps)
        return float(self(prediction, target, inside, maps)) if present else math.nan


def _check_class(name: str, cls: type) -> None:
    """Refuse a class that cannot be scored, and derive a missing title from the name.

    Raises:
        NerfroError: the class does not derive from `ImageMetric`, or lacks `better` or the parameter `inside`.
    """
    what = f"metric={name}: class {cls.__name__}"
    if not issubclass(cls, ImageMetric):
        raise NerfroError(f"{what} is not a metric; derive it from {ImageMetric.__module__}.ImageMetric")
    if getattr(cls, "better", None) not in ("higher", "lower"):
        raise NerfroError(f'{what} does not say which scores are better; add better = "higher" or better = "lower"')
    parameters = inspect.signature(cls.forward).parameters
    inside = parameters.get("inside")
    if inside is None or inside.default is inside.empty:
        raise NerfroError(f"{what} cannot score a region; write forward(self, prediction, target, inside=None)")
    if cls.maps and "maps" not in parameters:
        raise NerfroError(f"{what} needs maps; write forward(self, prediction, target, inside=None, maps=None)")
    cls.title = getattr(cls, "title", name)


CHECKS["metric"] = _check_class


def image_metrics(names: Sequence[str] | None = None) -> dict[str, type[ImageMetric]]:
    """Return registered metrics by name.

    Args:
        names: names of the metrics, in the order of the result; by default all, in the order of tables.

    Raises:
        NerfroError: a metric is not registered, or `names` is empty.
    """
    discover()
    registered = {plugin.name: plugin.cls for plugin in plugins("metric")}
    names = sorted(registered, key=lambda name: (*_FIRST, name).index(name)) if names is None else names
    unknown = next((name for name in names if name not in registered), None)
    if unknown is not None or not names:
        problem = f"'{unknown}' is not a metric" if names else "the list is empty"
        raise NerfroError(f"metrics: {problem}; {nearest_of(str(unknown), list(registered))}")
    return {name: registered[name] for name in names}


def build_metrics(names: Sequence[str] | None = None) -> dict[str, ImageMetric]:
    """Build metrics, see `image_metrics`."""
    return {name: create(find("metric", name), {}) for name in image_metrics(names)}


def psnr(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio, -10 log10(mean squared error); higher is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        PSNR in dB, at most `MAX_PSNR`, which a mean squared error below 1e-10 reaches; NaN for an empty mask.

    Raises:
        NerfroError: the sizes of the images differ.
    """
    require_images(prediction, target, inside)
    errors = squared_error_map(prediction.double(), target.double())
    return (-10 * torch.log10(mean_over(errors, inside))).clamp(max=MAX_PSNR)


@register("metric", "psnr")
class Psnr(ImageMetric):
    """Peak signal-to-noise ratio, dB."""

    title = "PSNR"
    better = "higher"
    decimals = 2
    forward = staticmethod(psnr)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        return ErrorMap("squared_error", "squared error", squared_error_map(prediction, target), SQUARED_ERROR_LIMIT)


@register("metric", "ssim")
class Ssim(ImageMetric):
    """Structural similarity."""

    title = "SSIM"
    better = "higher"
    min_size = WINDOW
    forward = staticmethod(ssim)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        """Compute 1 - SSIM; NaN in a border of five pixels, because windows there would exceed the image."""
        values = F.pad(1 - ssim_map(prediction, target).mean(-1), [WINDOW // 2] * 4, value=torch.nan)
        return ErrorMap("ssim", "1 - SSIM", values, 1.0)


@register("metric", "depth")
class DepthError(ImageMetric):
    """Root mean squared error of the depth in pixels that have one, world units.

    Depth cameras and structure from motion assume straight rays, so pixels whose rays meet the medium do not count.
    """

    title = "depth RMSE"
    better = "lower"
    maps = ("depth",)

    def forward(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
        maps: ViewMaps | None = None,
    ) -> Float[Tensor, ""]:
        assert maps is not None
        depth, rendered = maps.data["depth"][..., 0].to(prediction), maps.rendered["depth"][..., 0].to(prediction)
        valid = (depth > 0) & (maps.rendered["refracted"][..., 0].to(prediction) == 0)
        return mean_over((rendered - depth).square(), valid if inside is None else valid & inside).sqrt()
