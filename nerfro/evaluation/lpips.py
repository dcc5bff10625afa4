"""Learned perceptual image patch similarity (LPIPS v0.1) over the features of AlexNet or VGG-16.

Written out here because torchmetrics and lpips both take the networks from torchvision, whose published builds do not
load beside a CPU build of torch. The linear heads are the published ones, under lpips' licence beside them; the values
are those of both packages.

Source:
    Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.errors import NerfroError
from nerfro.evaluation.pretrained import ALEXNET, VGG16, Published, load_weights
from nerfro.evaluation.regions import mean_over
from nerfro.paths import ASSETS_DIR

_HEADS = ASSETS_DIR / "_lpips/heads.npz"  # alex<l> and vgg<l>, lpips v0.1


class Convolution(NamedTuple):
    """One layer of a backbone, followed by a ReLU."""

    key: str
    channels_in: int
    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pooling: int = 0  # side of the windows, with stride 2, over which its input is max-pooled; 0 for none
    compared: bool = True  # whether its output is a feature of LPIPS


class Backbone(NamedTuple):
    """A network whose features are compared."""

    published: Published  # where its weights are
    heads: str  # name of its linear heads in the file of published ones
    min_size: int  # pixels; in smaller pictures the last pooling has nothing left to pool
    layers: tuple[Convolution, ...]  # its convolutions, in order


ALEX = Backbone(
    ALEXNET,
    "alex",
    31,
    (
        Convolution("features.0", 3, 64, kernel=11, stride=4, padding=2),
        Convolution("features.3", 64, 192, kernel=5, padding=2, pooling=3),
        Convolution("features.6", 192, 384, pooling=3),
        Convolution("features.8", 384, 256),
        Convolution("features.10", 256, 256),
    ),
)
VGG = Backbone(
    VGG16,
    "vgg",
    16,
    (
        Convolution("features.0", 3, 64, compared=False),
        Convolution("features.2", 64, 64),
        Convolution("features.5", 64, 128, pooling=2, compared=False),
        Convolution("features.7", 128, 128),
        Convolution("features.10", 128, 256, pooling=2, compared=False),
        Convolution("features.12", 256, 256, compared=False),
        Convolution("features.14", 256, 256),
        Convolution("features.17", 256, 512, pooling=2, compared=False),
        Convolution("features.19", 512, 512, compared=False),
        Convolution("features.21", 512, 512),
        Convolution("features.24", 512, 512, pooling=2, compared=False),
        Convolution("features.26", 512, 512, compared=False),
        Convolution("features.28", 512, 512),
    ),
)


class LpipsNetwork(nn.Module):
    """Five feature layers of a backbone, and how much a difference in each channel matters.

    d(x, y) = sum_l mean_hw w_l . (f_l(x) - f_l(y))^2, with f_l of unit length over channels (Eqn. 1 of the paper).

    All weights are buffers that are not saved: a model that holds this network neither trains nor stores it.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: Backbone, weights: dict[str, Tensor], heads: Sequence[Float[Tensor, "C"]]) -> None:
        """Take the weights of the backbone, as in its state dict, and of a linear head for each layer compared."""
        super().__init__()
        self.backbone = backbone
        for i, layer in enumerate(backbone.layers):
            shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
            self._take(f"kernel{i}", weights, f"{layer.key}.weight", shape)
            self._take(f"bias{i}", weights, f"{layer.key}.bias", (layer.channels,))
        for i, head in enumerate(heads):
            self.register_buffer(f"head{i}", head.view(1, -1, 1, 1), persistent=False)
        # The colours of ImageNet, for inputs in [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1), persistent=False)

    def forward(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
    ) -> Float[Tensor, ""]:
        """Perceptual distance of two pictures, sRGB in [0, 1]: the sum of the layers' means, as published.

        With a mask it is the mean of `distance_map` over its pixels, and NaN if there are none.
        """
        if inside is not None:
            return mean_over(self.distance_map(prediction, target), inside)
        return torch.stack([layer.mean() for layer in self._layer_distances(prediction, target)]).sum()

    def distance_map(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        """Perceptual distance around each pixel, for error maps: the layers enlarged bilinearly and added.

        The mean is close to, but not the same as, the distance of `forward`.
        """
        size = prediction.shape[:2]
        layers = self._layer_distances(prediction, target)
        enlarged = [F.interpolate(layer, size=size, mode="bilinear", align_corners=False) for layer in layers]
        return torch.stack(enlarged).sum(0)[0, 0]

    def _take(self, name: str, weights: dict[str, Tensor], key: str, shape: tuple[int, ...]) -> None:
        if key not in weights or tuple(weights[key].shape) != shape:
            found = list(weights[key].shape) if key in weights else "nothing"
            raise NerfroError(
                f"LPIPS weights: expected {key} of shape {list(shape)}, found {found}; "
                f"use the file of {self.backbone.published.title} itself"
            )
        self.register_buffer(name, weights[key].detach().float().clone(), persistent=False)

    def _layer_distances(self, prediction: Tensor, target: Tensor) -> list[Float[Tensor, "1 1 h w"]]:
        size = self.backbone.min_size
        if min(prediction.shape[:2]) < size:
            raise NerfroError(f"LPIPS needs at least {size} x {size} pixels, got {list(prediction.shape[:2])}")
        # Under mixed precision the features would be half ones, and the distances 1e-3 off.
        with torch.autocast(prediction.device.type, enabled=False):
            pairs = zip(self._features(prediction), self._features(target), strict=True)
            return [
                F.conv2d((unit_length(f) - unit_length(g)).square(), getattr(self, f"head{i}"))
                for i, (f, g) in enumerate(pairs)
            ]

    def _features(self, rgb: Float[Tensor, "H W 3"]) -> list[Float[Tensor, "1 C h w"]]:
        x = (2 * rgb.float().permute(2, 0, 1)[None] - 1 - self.shift) / self.scale
        features = []
        for i, layer in enumerate(self.backbone.layers):
            if layer.pooling:
                x = F.max_pool2d(x, layer.pooling, stride=2)
            kernel, bias = getattr(self, f"kernel{i}"), getattr(self, f"bias{i}")
            x = F.relu(F.conv2d(x, kernel, bias, layer.stride, layer.padding))
            if layer.compared:
                features.append(x)
        return features


def unit_length(features: Float[Tensor, "1 C h w"]) -> Float[Tensor, "1 C h w"]:
    """Scale the feature vector of each position to length one; zero stays zero."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


def load_lpips_network(backbone: Backbone, path: Path | str | None = None, download: bool = True) -> LpipsNetwork:
    """A network on the CPU, with the published weights: see `load_weights` for `path` and `download`."""
    with np.load(_HEADS, allow_pickle=False) as file:
        layers = range(sum(layer.compared for layer in backbone.layers))
        heads = [torch.from_numpy(file[f"{backbone.heads}{i}"]) for i in layers]
    return LpipsNetwork(backbone, load_weights(backbone.published, path, download), heads)


def find_lpips_networks(
    alex: Path | str | None = None, vgg: Path | str | None = None, download: bool = True
) -> tuple[dict[str, LpipsNetwork], dict[str, str]]:
    """Build the networks whose weights can be had, and say why not the others.

    Args:
        alex: file with AlexNet's weights; by default torch hub's cache, or the network.
        vgg: file with VGG-16's weights; by default torch hub's cache. They are never fetched unasked: 528 MB.
        download: whether AlexNet's weights may be fetched when they are not cached.

    Returns:
        By the name of their metric, `lpips` and `lpips_vgg`: the networks, and the reasons for those that are missing.

    Raises:
        NerfroError: if a file is given and is not that network's: whoever names a file wants it used.
    """
    networks, reasons = {}, {}
    for metric, backbone, path, fetched in (("lpips", ALEX, alex, download), ("lpips_vgg", VGG, vgg, False)):
        try:
            networks[metric] = load_lpips_network(backbone, path, fetched)
        except NerfroError as error:
            if path is not None:
                raise
            reasons[metric] = str(error)
    return networks, reasons
