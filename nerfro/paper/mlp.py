"""Positional encodings, and the NeRF MLP: a trunk for density and a view-dependent branch for colour."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.paper.linear import Linear, linear

# Octaves of the encoded viewing direction in NeRF, mip-NeRF and the paper.
DIRECTION_DEGREE = 4


def positional_encoding(x: Float[Tensor, "*batch D"], num_octaves: int) -> Float[Tensor, "*batch F"]:
    """Encode x by sines and cosines at the octaves 1, 2, 4, ... (NeRF, Eqn. 4).

    As in mip-NeRF's code, frequencies have no factor pi and x is not normalized.

    Returns:
        x, all sines, and all cosines; F = D (2 num_octaves + 1).
    """
    scales = 2.0 ** torch.arange(num_octaves, device=x.device, dtype=x.dtype)
    angles = (x[..., None, :] * scales[:, None]).flatten(-2)
    return torch.cat([x, torch.sin(torch.cat([angles, angles + 0.5 * math.pi], dim=-1))], dim=-1)


def integrated_positional_encoding(
    mean: Float[Tensor, "*batch 3"], variance: Float[Tensor, "*batch 3"], num_octaves: int
) -> Float[Tensor, "*batch F"]:
    """Return expected sines and cosines of a Gaussian with diagonal covariance (mip-NeRF, Eqn. 13)."""
    scales = 2.0 ** torch.arange(num_octaves, device=mean.device, dtype=mean.dtype)
    angles = (mean[..., None, :] * scales[:, None]).flatten(-2)
    damping = torch.exp(-0.5 * (variance[..., None, :] * scales[:, None] ** 2).flatten(-2))
    return torch.cat([torch.sin(angles) * damping, torch.sin(angles + 0.5 * math.pi) * damping], dim=-1)


# Colours extend slightly beyond [0, 1], so that black and white need no infinite activation (mip-NeRF's code).
RGB_PADDING = 1e-3

# Points that are evaluated together. Results of layers have equal sizes, so the allocator reuses freed memory.
_BLOCK = 2**12


def in_blocks(
    evaluate: Callable[..., tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]],
    *points: Float[Tensor, "*batch _"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Evaluate densities and colours in blocks of points, whose intermediate results need little memory."""
    batch = points[0].shape[:-1]
    blocks = zip(*(tensor.flatten(0, -2).split(_BLOCK) for tensor in points), strict=True)
    densities, colours = zip(*(evaluate(*block) for block in blocks), strict=True)
    return torch.cat(densities).view(batch), torch.cat(colours).view(*batch, 3)


class SkipMLP(nn.Module):
    """ReLU layers with a skip connection: the input is concatenated to the output of layer `skip` (counted from 1).

    Weights are Glorot-uniform and biases are zero, as in the authors' code.
    """

    def __init__(self, num_inputs: int, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self.skip = skip
        inputs = [num_inputs] + [width + num_inputs * (i == skip) for i in range(1, depth)]
        self.layers = nn.ModuleList(glorot_linear(n, width) for n in inputs)
        self.num_outputs = width + num_inputs * (skip == depth)

    def forward(self, x: Float[Tensor, "*batch I"]) -> Float[Tensor, "*batch O"]:
        batch = x.shape[:-1]
        y = x = x.reshape(-1, x.shape[-1]).to(self.layers[0].weight.dtype)  # type: ignore[arg-type]
        for i, layer in enumerate(self.layers, start=1):
            y = F.relu(layer(y, x) if i == self.skip + 1 else layer(y), inplace=True)
        if self.skip == len(self.layers):
            y = torch.cat([y, x.to(y.dtype)], dim=-1)
        return y.view(*batch, self.num_outputs)


class RadianceMLP(nn.Module):
    """Map encoded positions and directions to density (softplus of raw - 1) and colour (padded sigmoid).

    Args:
        num_position, num_direction: widths of the encodings.
        width, depth, skip: shape of the trunk; NeRF uses 256, 8 and 5.
        view_width: width of the layer that takes the direction.
    """

    def __init__(
        self, num_position: int, num_direction: int, width: int, depth: int, skip: int, view_width: int
    ) -> None:
        super().__init__()
        self.trunk = SkipMLP(num_position, width, depth, skip)
        self.density = glorot_linear(self.trunk.num_outputs, 1)
        self.bottleneck = glorot_linear(self.trunk.num_outputs, width)
        self.view = glorot_linear(width + num_direction, view_width)
        self.rgb = glorot_linear(view_width, 3)

    def forward(
        self, position: Float[Tensor, "*batch I"], direction: Float[Tensor, "*batch D"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        features = self.trunk(position)
        density = F.softplus(self.density(features).squeeze(-1).float() - 1.0)
        return density, padded_sigmoid(self.rgb(F.relu(self._view(features, direction))))

    def _view(
        self, features: Float[Tensor, "*batch F"], direction: Float[Tensor, "*batch D"]
    ) -> Float[Tensor, "*batch O"]:
        """Apply bottleneck and view layer as one layer, because no activation lies between the two.

        The product of their weights needs fewer operations than the two layers, and no memory for the bottleneck.
        """
        of_bottleneck, of_direction = self.view.weight.split([len(self.bottleneck.weight), direction.shape[-1]], 1)
        weight = torch.cat([of_bottleneck @ self.bottleneck.weight, of_direction], 1)
        bias = self.view.bias + of_bottleneck @ self.bottleneck.bias
        return linear(weight, bias, features, direction)


def glorot_linear(num_inputs: int, num_outputs: int) -> nn.Linear:
    """Create a linear layer with Glorot-uniform weights and zero bias."""
    layer = Linear(num_inputs, num_outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def padded_sigmoid(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Evaluate a sigmoid with range [-0.001, 1.001] in single precision."""
    return torch.sigmoid(raw.float()) * (1 + 2 * RGB_PADDING) - RGB_PADDING
