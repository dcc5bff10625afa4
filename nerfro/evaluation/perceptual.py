"""Perceptual metrics of images: LPIPS v0.1 with features of AlexNet, and FLIP; see docs/reference/metrics.md.

The packages torchmetrics and lpips load the network from torchvision, whose published builds do not work beside a CPU
build of torch, and download 233 MB of weights. Therefore this module implements the network, and nerfro contains the
five convolutions, in half precision, and the linear heads of the package lpips (see the licences beside the files). The
values agree with both packages.

FLIP is the visibility of the difference between two images that alternate on a screen. The values are computed by the
authors' package flip-evaluator for low dynamic range (LDR) and its default viewing conditions: 67 pixels per degree,
that is, a display of 0.7 m width and 3840 pixels at a distance of 0.7 m.

Sources:
    Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
    Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.paths import ASSETS_DIR
from nerfro.evaluation.image_metrics import ErrorMap, ImageMetric, mean_over, require_images
from nerfro.registry.registration import register

# Arrays features.<i>.weight and features.<i>.bias of torchvision, and alex<l> of lpips v0.1.
_CONVOLUTIONS, _HEADS = ASSETS_DIR / "_lpips/alexnet.npz", ASSETS_DIR / "_lpips/heads.npz"
MIN_SIZE = 31  # pixels; in smaller images, the last pooling has an empty input


class Convolution(NamedTuple):
    """One convolution of AlexNet, followed by a ReLU."""

    key: str
    stride: int = 1
    padding: int = 1
    pooling: bool = False  # whether a max pooling of 3 x 3 pixels with stride 2 precedes the convolution


CONVOLUTIONS = (
    Convolution("features.0", stride=4, padding=2),
    Convolution("features.3", padding=2, pooling=True),
    Convolution("features.6", pooling=True),
    Convolution("features.8"),
    Convolution("features.10"),
)


class LpipsNetwork(nn.Module):
    """LPIPS network: AlexNet with five feature layers, and a weight for each channel of these.

    d(x, y) = sum_l mean_hw w_l . (f_l(x) - f_l(y))^2, where f_l has unit length over channels (Eqn. 1 of the paper).

    All weights are non-persistent buffers, so a model that contains this network neither trains nor saves it.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        """Create the network.

        Args:
            weights: convolutions under the names of AlexNet in torchvision, and the channel weights `alex<l>` of the
                layers.
        """
        super().__init__()
        for i, layer in enumerate(CONVOLUTIONS):
            self._register(f"kernel{i}", weights[f"{layer.key}.weight"])
            self._register(f"bias{i}", weights[f"{layer.key}.bias"])
            self._register(f"head{i}", weights[f"alex{i}"].view(1, -1, 1, 1))
        # Mean and standard deviation of ImageNet colours, for inputs in [-1, 1].
        self._register("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self._register("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))

    def forward(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
    ) -> Float[Tensor, ""]:
        """Compute the perceptual distance of two images; lower is better.

        Args:
            prediction: rendered image, sRGB in [0, 1].
            target: reference image, sRGB in [0, 1].
            inside: mask of the pixels that count. With a mask, the result is the mean of `distance_map`.

        Returns:
            Distance, without unit; NaN for an empty mask.
        """
        require_images(prediction, target, inside)
        if inside is not None:
            return mean_over(self.distance_map(prediction, target), inside)
        return torch.stack([layer.mean() for layer in self._layer_distances(prediction, target)]).sum()

    def distance_map(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        """Compute the perceptual distance around each pixel as the sum of the bilinearly enlarged layers.

        The mean of the map differs slightly from the distance of `forward`.
        """
        size = prediction.shape[:2]
        layers = self._layer_distances(prediction, target)
        enlarged = [F.interpolate(layer, size=size, mode="bilinear", align_corners=False) for layer in layers]
        return torch.stack(enlarged).sum(0)[0, 0]

    def _register(self, name: str, weights: Tensor) -> None:
        self.register_buffer(name, weights.detach().float().clone(), persistent=False)

    def _layer_distances(self, prediction: Tensor, target: Tensor) -> list[Float[Tensor, "1 1 _ _"]]:
        require_images(prediction, target)
        if min(prediction.shape[:2]) < MIN_SIZE:
            raise NerfroError(
                f"LPIPS needs at least {MIN_SIZE} x {MIN_SIZE} pixels, got {list(prediction.shape[:2])}; use SSIM"
            )
        # Mixed precision would compute features in half precision, with errors of 1e-3 in the distance.
        with torch.autocast(prediction.device.type, enabled=False):
            pairs = zip(self._features(prediction), self._features(target), strict=True)
            return [
                F.conv2d((unit_length(f) - unit_length(g)).square(), getattr(self, f"head{i}"))
                for i, (f, g) in enumerate(pairs)
            ]

    def _features(self, rgb: Float[Tensor, "H W 3"]) -> list[Float[Tensor, "1 _ _ _"]]:
        x = (2 * rgb.float().permute(2, 0, 1)[None] - 1 - self.shift) / self.scale
        features = []
        for i, layer in enumerate(CONVOLUTIONS):
            if layer.pooling:
                x = F.max_pool2d(x, 3, stride=2)
            kernel, bias = getattr(self, f"kernel{i}"), getattr(self, f"bias{i}")
            x = F.relu(F.conv2d(x, kernel, bias, layer.stride, layer.padding))
            features.append(x)
        return features


def unit_length(features: Float[Tensor, "1 C h w"]) -> Float[Tensor, "1 C h w"]:
    """Normalize the feature vector of each position to unit length; zero stays zero."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


@functools.cache
def published_weights() -> Mapping[str, Tensor]:
    """Read the convolutions of AlexNet and the linear heads that nerfro contains."""
    weights = {}
    for file in (_CONVOLUTIONS, _HEADS):
        with np.load(file, allow_pickle=False) as arrays:
            weights.update({name: torch.from_numpy(arrays[name]) for name in arrays.files})
    return weights


@register("metric", "lpips")
class Lpips(ImageMetric):
    """Learned perceptual image patch similarity."""

    title = "LPIPS"
    better = "lower"
    min_size = MIN_SIZE

    def __init__(self) -> None:
        super().__init__()
        self.network = LpipsNetwork(published_weights())

    def forward(self, prediction: Tensor, target: Tensor, inside: Tensor | None = None) -> Tensor:
        return self.network(prediction, target, inside)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        return ErrorMap("lpips", "LPIPS", self.network.distance_map(prediction, target), 1.0)


def flip_is_available() -> bool:
    """Test whether flip-evaluator is installed; the package has no wheel for Linux on ARM."""
    return importlib.util.find_spec("flip_evaluator") is not None


def flip_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Compute the visible difference of two images at each pixel.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].

    Returns:
        Values in [0, 1], float32; 0 for an invisible difference.
    """
    require_images(prediction, target)
    import flip_evaluator  # not available on every platform, see `flip_is_available`

    images = [image.detach().cpu().float().contiguous().numpy() for image in (target, prediction)]
    errors, _, _ = flip_evaluator.evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0]).to(prediction.device)


def flip(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the mean of `flip_map`; lower is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        Mean in [0, 1], without unit; NaN for an empty mask.
    """
    require_images(prediction, target, inside)
    return mean_over(flip_map(prediction, target), inside)


@register("metric", "flip")
class Flip(ImageMetric):
    """FLIP, the difference that is visible when flipping between two images."""

    title = "FLIP"
    better = "lower"
    missing = None if flip_is_available() else "the package flip-evaluator is not installed"
    forward = staticmethod(flip)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        return ErrorMap("flip", "FLIP", flip_map(prediction, target), 1.0)
