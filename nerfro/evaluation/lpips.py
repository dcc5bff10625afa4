"""Learned perceptual image patch similarity (LPIPS v0.1) over the features of AlexNet.

Written out here because torchmetrics and lpips both take AlexNet from torchvision, whose published builds do not load
beside a CPU build of torch. The linear heads are those that torchmetrics carries; the values are those of both
packages. Source: Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
import torchmetrics
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.errors import NerfroError
from nerfro.evaluation.pretrained import load_alexnet

MIN_PICTURE_SIZE = 31  # pixels; below, AlexNet's second pooling has nothing left to pool


class Convolution(NamedTuple):
    """One feature layer of AlexNet, followed by a ReLU."""

    key: str
    channels_in: int
    channels: int
    kernel: int
    stride: int
    padding: int
    pooled: bool  # whether its input is max-pooled, 3 x 3 with stride 2


ALEXNET = (
    Convolution("features.0", 3, 64, kernel=11, stride=4, padding=2, pooled=False),
    Convolution("features.3", 64, 192, kernel=5, stride=1, padding=2, pooled=True),
    Convolution("features.6", 192, 384, kernel=3, stride=1, padding=1, pooled=True),
    Convolution("features.8", 384, 256, kernel=3, stride=1, padding=1, pooled=False),
    Convolution("features.10", 256, 256, kernel=3, stride=1, padding=1, pooled=False),
)


class LpipsNetwork(nn.Module):
    """AlexNet's five feature layers, and how much a difference in each channel matters.

    d(x, y) = sum_l mean_hw w_l . (f_l(x) - f_l(y))^2, with f_l of unit length over channels (Eqn. 1 of the paper).

    All weights are buffers that are not saved: a model that holds this network neither trains nor stores it.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: dict[str, Tensor], heads: dict[str, Tensor]) -> None:
        """Take the weights.

        Args:
            backbone: AlexNet's state dict, `features.<i>.weight` and `features.<i>.bias`.
            heads: weights of the linear heads, `lin<l>.model.1.weight`, each [1, channels, 1, 1].

        Raises:
            NerfroError: if a weight is missing or of another shape.
        """
        super().__init__()
        for i, layer in enumerate(ALEXNET):
            shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
            self._take(f"kernel{i}", backbone, f"{layer.key}.weight", shape)
            self._take(f"bias{i}", backbone, f"{layer.key}.bias", (layer.channels,))
            self._take(f"head{i}", heads, f"lin{i}.model.1.weight", (1, layer.channels, 1, 1))
        # The colours of ImageNet, for inputs in [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1), persistent=False)

    def forward(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Perceptual distance of two pictures.

        Args:
            prediction: sRGB in [0, 1].
            target: sRGB in [0, 1].

        Returns:
            Distance, 0 for equal pictures.

        Raises:
            NerfroError: if the picture is smaller than `MIN_PICTURE_SIZE`.
        """
        return torch.stack([layer.mean() for layer in self._layer_distances(prediction, target)]).sum()

    def distance_map(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        """Perceptual distance around each pixel, for error maps: the layers enlarged bilinearly and added.

        Args:
            prediction: sRGB in [0, 1].
            target: sRGB in [0, 1].

        Returns:
            Distances; their mean is close to, but not the same as, that of `forward`.

        Raises:
            NerfroError: if the picture is smaller than `MIN_PICTURE_SIZE`.
        """
        size = prediction.shape[:2]
        layers = self._layer_distances(prediction, target)
        enlarged = [F.interpolate(layer, size=size, mode="bilinear", align_corners=False) for layer in layers]
        return torch.stack(enlarged).sum(0)[0, 0]

    def _take(self, name: str, weights: dict[str, Tensor], key: str, shape: tuple[int, ...]) -> None:
        if key not in weights or tuple(weights[key].shape) != shape:
            found = list(weights[key].shape) if key in weights else "nothing"
            raise NerfroError(
                f"LPIPS weights: expected {key} of shape {list(shape)}, found {found}; use the file of AlexNet itself"
            )
        self.register_buffer(name, weights[key].detach().float().clone(), persistent=False)

    def _layer_distances(self, prediction: Tensor, target: Tensor) -> list[Float[Tensor, "1 1 h w"]]:
        if min(prediction.shape[:2]) < MIN_PICTURE_SIZE:
            raise NerfroError(
                f"LPIPS needs at least {MIN_PICTURE_SIZE} x {MIN_PICTURE_SIZE} pixels, got {list(prediction.shape[:2])}"
            )
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
        for i, layer in enumerate(ALEXNET):
            if layer.pooled:
                x = F.max_pool2d(x, kernel_size=3, stride=2)
            kernel, bias = getattr(self, f"kernel{i}"), getattr(self, f"bias{i}")
            x = F.relu(F.conv2d(x, kernel, bias, layer.stride, layer.padding))
            features.append(x)
        return features


class LearnedPerceptualSimilarity(torchmetrics.Metric):
    """Mean LPIPS over pictures."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, network: LpipsNetwork) -> None:
        """Start with no pictures.

        Args:
            network: see `load_lpips_network`.
        """
        super().__init__()
        self.network = network
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    @torch.no_grad()
    def update(self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> None:
        """Add one picture, sRGB in [0, 1]."""
        self.total += self.network(prediction, target).double()
        self.count += 1

    def compute(self) -> Float[Tensor, ""]:
        """Mean distance of the pictures so far."""
        return self.total / self.count


def unit_length(features: Float[Tensor, "1 C h w"]) -> Float[Tensor, "1 C h w"]:
    """Scale the feature vector of each position to length one; zero stays zero."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


def load_lpips_network(backbone: Path | str | None = None, download: bool = True) -> LpipsNetwork:
    """Build the network with the published weights.

    Args:
        backbone: file with AlexNet's weights; by default torch hub's cache, or the network.
        download: whether the weights may be fetched when they are not cached.

    Returns:
        The network, on the CPU.

    Raises:
        NerfroError: if the weights cannot be had, or are not AlexNet's.
    """
    with as_file(files("torchmetrics") / "functional/image/lpips_models/alex.pth") as path:
        heads = torch.load(path, map_location="cpu", weights_only=True)
    return LpipsNetwork(load_alexnet(backbone, download), heads)


def find_lpips_network(backbone: Path | str | None = None, download: bool = True) -> tuple[LpipsNetwork | None, str]:
    """Build the network if its weights can be had, and say why if not.

    Args:
        backbone: file with AlexNet's weights; by default torch hub's cache, or the network.
        download: whether the weights may be fetched when they are not cached.

    Returns:
        The network and "", or None and the reason in one line.

    Raises:
        NerfroError: if `backbone` is given and is not AlexNet's file: whoever names a file wants it used.
    """
    try:
        return load_lpips_network(backbone, download), ""
    except NerfroError as error:
        if backbone is not None:
            raise
        return None, str(error)
