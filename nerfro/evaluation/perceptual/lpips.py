"""Learned perceptual image patch similarity (LPIPS v0.1) with features of AlexNet.

The packages torchmetrics and lpips load the network from torchvision, whose published builds do not work beside a CPU
build of torch. Therefore this module implements the network. The linear heads are those of the package lpips (see the
licence beside the file), and the values agree with both packages.

Source:
    Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.paths import ASSETS_DIR
from nerfro.evaluation.error_maps import ErrorMap
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.evaluation.perceptual.pretrained import load_weights
from nerfro.evaluation.regions import mean_over, require_images
from nerfro.registry.registration import register

_HEADS = ASSETS_DIR / "_lpips/heads.npz"  # arrays alex<l> of lpips v0.1
MIN_SIZE = 31  # pixels; in smaller images, the last pooling has an empty input


class Convolution(NamedTuple):
    """One convolution of AlexNet, followed by a ReLU."""

    key: str
    channels_in: int
    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pooling: bool = False  # whether a max pooling of 3 x 3 pixels with stride 2 precedes the convolution


CONVOLUTIONS = (
    Convolution("features.0", 3, 64, kernel=11, stride=4, padding=2),
    Convolution("features.3", 64, 192, kernel=5, padding=2, pooling=True),
    Convolution("features.6", 192, 384, pooling=True),
    Convolution("features.8", 384, 256),
    Convolution("features.10", 256, 256),
)


class LpipsNetwork(nn.Module):
    """LPIPS network: AlexNet with five feature layers, and a weight for each channel of these.

    d(x, y) = sum_l mean_hw w_l . (f_l(x) - f_l(y))^2, where f_l has unit length over channels (Eqn. 1 of the paper).

    All weights are non-persistent buffers, so a model that contains this network neither trains nor saves it.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, weights: dict[str, Tensor], heads: Sequence[Float[Tensor, "..."]]) -> None:
        """Create the network.

        Args:
            weights: state dict of AlexNet.
            heads: channel weights of each layer.

        Raises:
            NerfroError: a weight is missing or has the wrong shape.
        """
        super().__init__()
        for i, layer in enumerate(CONVOLUTIONS):
            shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
            self._register(f"kernel{i}", weights, f"{layer.key}.weight", shape)
            self._register(f"bias{i}", weights, f"{layer.key}.bias", (layer.channels,))
        for i, head in enumerate(heads):
            self.register_buffer(f"head{i}", head.view(1, -1, 1, 1), persistent=False)
        # Mean and standard deviation of ImageNet colours, for inputs in [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1), persistent=False)

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

    def _register(self, name: str, weights: dict[str, Tensor], key: str, shape: tuple[int, ...]) -> None:
        if key not in weights or tuple(weights[key].shape) != shape:
            found = list(weights[key].shape) if key in weights else "none"
            raise NerfroError(
                f"LPIPS weights: expected {key} of shape {list(shape)}, found {found}; "
                "use the published file of AlexNet"
            )
        self.register_buffer(name, weights[key].detach().float().clone(), persistent=False)

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


def load_lpips_network(weights: dict[str, Tensor]) -> LpipsNetwork:
    """Build a network with the weights of AlexNet and the published heads, on the CPU."""
    with np.load(_HEADS, allow_pickle=False) as file:
        heads = [torch.from_numpy(file[f"alex{i}"]) for i in range(len(CONVOLUTIONS))]
    return LpipsNetwork(weights, heads)


@register("metric", "lpips")
class Lpips(ImageMetric):
    """Learned perceptual image patch similarity."""

    title = "LPIPS"
    better = "lower"
    min_size = MIN_SIZE

    def __init__(self) -> None:
        super().__init__()
        self.missing = "no network was given"
        self.network: LpipsNetwork | None = None

    def prepare(self) -> None:
        """Load the network, or keep the reason why its weights are not available."""
        try:
            self.network, self.missing = load_lpips_network(load_weights()), None
        except NerfroError as error:
            self.missing = str(error)

    def forward(self, prediction: Tensor, target: Tensor, inside: Tensor | None = None) -> Tensor:
        assert self.network is not None
        return self.network(prediction, target, inside)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        assert self.network is not None
        return ErrorMap("lpips", "LPIPS", self.network.distance_map(prediction, target), 1.0)
