"""The skybox of the paper: a small MLP of the exit direction."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.geometry.space import Space
from nerfro.paper.encoding import DIRECTION_DEGREE, positional_encoding
from nerfro.paper.mlp import SkipMLP, glorot_linear, padded_sigmoid
from nerfro.registry.allowed import Depth, Width
from nerfro.registry.registration import register


@register("background", "skybox")
class Skybox(Background):
    """Represent the background by a 4x128 MLP of the encoded exit direction (paper, Eqn. 5, F_psi).

    The radiance is a sigmoid and at most 1, as in the authors' code. Bright lamps are therefore clipped.

    Args:
        width: number of units in each hidden layer.
        depth: number of hidden layers.
        skip: number of the layer after which the input is concatenated again.
    """

    def __init__(self, width: Width = 128, depth: Depth = 4, skip: int = 3) -> None:
        super().__init__()
        self.trunk = SkipMLP(3 * (1 + 2 * DIRECTION_DEGREE), width, depth, skip)
        self.rgb = glorot_linear(self.trunk.num_outputs, 3)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        views.refuse_linear_light("background=skybox")
        return {}

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        return padded_sigmoid(self.rgb(self.trunk(positional_encoding(exits.directions, DIRECTION_DEGREE))))
