"""The NeRF MLP: a trunk for density and a view-dependent branch for colour."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfro.fields.mlp import Network, SkipMLP, glorot_linear, padded_sigmoid
from nerfro.kernels.linear import linear


class RadianceMLP(Network):
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
        self, position: Float[Tensor, "*batch P"], direction: Float[Tensor, "*batch D"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        features = self.trunk(position)
        density = F.softplus(self.density(features).squeeze(-1).float() - 1.0)
        return density, padded_sigmoid(self.rgb(F.relu(self._view(features, direction))))

    def _view(
        self, features: Float[Tensor, "*batch F"], direction: Float[Tensor, "*batch D"]
    ) -> Float[Tensor, "*batch V"]:
        """Apply bottleneck and view layer as one layer, because no activation lies between the two.

        The product of their weights needs fewer operations than the two layers, and no memory for the bottleneck.
        """
        of_bottleneck, of_direction = self.view.weight.split([len(self.bottleneck.weight), direction.shape[-1]], 1)
        weight = torch.cat([of_bottleneck @ self.bottleneck.weight, of_direction], 1)
        bias = self.view.bias + of_bottleneck @ self.bottleneck.bias
        return linear(weight, bias, features, direction)
