"""Camera models: the interface for estimated poses, lens and exposures, and the model that keeps the cameras.

Exposure, white balance and appearance of photographs are gains per view and colour channel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.light import saturated
from nerfro.core.rays import Rays
from nerfro.registry.allowed import Natural
from nerfro.registry.registration import register


class PerView(nn.Module):
    """Module whose tensors are empty until `begin` or the loading of a checkpoint sets the number of views."""

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, tensor in (*self._parameters.items(), *self._buffers.items()):
            stored = state_dict.get(prefix + name)
            if tensor is not None and stored is not None and len(tensor) == 0:
                tensor.data = stored.new_empty(stored.shape, dtype=tensor.dtype, device=tensor.device)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class Exposure(PerView):
    """Gain of linear radiance for each view and colour channel.

    The mean logarithm of the gains is zero, because the overall brightness of the scene is otherwise ambiguous.

    Args:
        appearance: size of the embedding of each view, see `Appearance`; 0 for none.
    """

    def __init__(self, appearance: int = 0) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(0, 3))
        self.appearance = Appearance(appearance) if appearance else None

    def begin(self, cameras: Cameras) -> None:
        """Initialize the gains with 1."""
        self.log_gain.data = self.log_gain.new_zeros(len(cameras), 3)
        if self.appearance is not None:
            self.appearance.begin(cameras)

    def forward(self, view: Int[Tensor, "R"], rays: Rays) -> Float[Tensor, "R 3"]:
        gains = self.gains()[view]
        return gains if self.appearance is None else gains * self.appearance(view, rays)

    def gains(self) -> Float[Tensor, "V 3"]:
        """Return the gains of all views."""
        return torch.exp(self.log_gain - self.log_gain.mean(0))

    @torch.no_grad()
    def fit(
        self,
        view: Int[Tensor, "R"],
        rays: Rays,
        radiance: Float[Tensor, "R 3"],
        photographed: Float[Tensor, "R 3"],
    ) -> None:
        """Set the gain of each view to the least-squares ratio of photographed to predicted linear radiance.

        Args:
            view: view of each pixel.
            rays: ray of each pixel.
            radiance: predicted linear radiance without gain.
            photographed: linear radiance in the photograph; saturated values are ignored.
        """
        unsaturated = ~saturated(photographed)
        if self.appearance is not None:
            radiance = radiance * self.appearance(view, rays)
        products = torch.stack([photographed * radiance, radiance * radiance]) * unsaturated
        sums = products.new_zeros(2, *self.log_gain.shape).index_add(1, view, products)
        # A black photograph has no gain.
        self.log_gain.copy_(torch.where((sums > 0).all(0), (sums[0] / sums[1]).log(), self.log_gain))

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithmic gains over views."""
        return float(self.gains().detach().log().std(0, unbiased=False).mean())


class Appearance(PerView):
    """Smooth gain over the image of each view, from a learned embedding (Martin-Brualla et al., NeRF-W, CVPR 2021).

    The logarithm of the gain is the product of the embedding, minus the mean of all embeddings, and of a function of
    the position in the image, which a small network computes and all views share. Therefore the mean logarithm over the
    views is zero at each position, so that the scene has the mean appearance, and so has every other view. In contrast
    to NeRF-W, whose field depends on the embedding, the gain acts on the light of field, background and object alike.

    Args:
        size: size of the embeddings.
    """

    axes: Float[Tensor, "V 3 3"]

    def __init__(self, size: int) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.zeros(0, size))
        self.basis = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 3 * size))
        self.register_buffer("axes", torch.zeros(0, 3, 3))

    def begin(self, cameras: Cameras) -> None:
        """Initialize the embeddings with zero, which means a gain of 1."""
        parameter = self.embedding
        parameter.data = parameter.new_zeros(len(cameras), parameter.shape[1])
        ones = torch.ones_like(cameras.fx)
        scales = torch.stack([2 * cameras.fx / cameras.width, 2 * cameras.fy / cameras.height, ones], -1)
        self.axes = scales[..., None] * cameras.camera_to_world[..., :3].mT.to(scales)

    def forward(self, view: Int[Tensor, "R"], rays: Rays) -> Float[Tensor, "R 3"]:
        # Finite for all directions, also of cameras that see more than a half-space.
        position = F.normalize((self.axes[view] @ rays.directions.detach()[..., None])[..., 0], dim=-1)[..., :2]
        embedding = (self.embedding - self.embedding.mean(0))[view]
        return torch.exp((self.basis(position).unflatten(-1, (3, -1)) * embedding[:, None]).sum(-1))


def fit_gain(
    encode: Callable[[Tensor], Tensor], radiance: Float[Tensor, "Q 3"], target: Float[Tensor, "Q 3"]
) -> Float[Tensor, "3"]:
    """Fit the gain of each channel that best maps rendered radiance to a photograph (Gauss-Newton).

    Args:
        encode: conversion from linear radiance to the colour space of the photograph.
        radiance: rendered linear radiance of each pixel.
        target: colours of the photograph.
    """
    with torch.inference_mode(False), torch.enable_grad():
        radiance, target = radiance.double().clone(), target.double().clone()
        logarithm = torch.zeros(3, dtype=torch.float64, device=radiance.device)
        for _ in range(20):
            log_gains = logarithm.expand_as(radiance).clone().requires_grad_()
            shown = encode(log_gains.exp() * radiance)
            (slope,) = torch.autograd.grad(shown.sum(), log_gains)
            # Pixels that are saturated in both images carry no information.
            clipped = saturated(target) & (shown > 1)
            error, slope = (value.masked_fill(clipped, 0) for value in (shown.detach() - target, slope))
            step = (slope * error).sum(0) / slope.square().sum(0).clamp(min=1e-12)
            logarithm = logarithm - step.clamp(-1, 1)
    return logarithm.exp().float()


class CameraModel(nn.Module, ABC):
    """Estimated poses, lens and exposures of the training views. Derive from this class to add a camera model.

    Gradient descent learns the exposures; poses and lens are moved by the phase `cameras`.

    Args:
        exposure: whether to estimate a gain for each training view.
        appearance: size of the embedding of each training view, from which a smooth gain over its image is learned, in
            addition to its exposure; 0 for none.

    Attributes:
        moves: whether the model changes the poses or the lens of the data set.
    """

    moves = False

    def __init__(self, exposure: bool = False, appearance: int = 0) -> None:
        super().__init__()
        self.exposure = Exposure(appearance) if exposure or appearance else None

    def begin(self, cameras: Cameras) -> None:
        """Initialize the model for the training views, given the cameras of the data set."""
        if self.exposure is not None:
            self.exposure.begin(cameras)

    @abstractmethod
    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """Map rays of the cameras of the data set to rays of the estimated cameras.

        Args:
            rays: rays in world units.
            view: index of the training view of each ray.
        """

    def gains(self, view: Int[Tensor, "R"], rays: Rays) -> Float[Tensor, "R 3"] | None:
        """Return the gain of linear radiance of each ray's photograph, or None if exposures are not estimated."""
        return None if self.exposure is None else self.exposure(view, rays)

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        """Return the parameters that gradient descent learns by name, see `Scene.parameters_by_name`."""
        return {f"cameras.{name.removesuffix('.log_gain')}": value for name, value in self.named_parameters()}

    def estimated(self, cameras: Cameras) -> Cameras:
        """Return the estimated training cameras, given those of the data set."""
        return cameras

    def aligned(self, cameras: Cameras) -> Cameras:
        """Apply the similarity transformation between the given and the estimated training cameras to other cameras."""
        return cameras

    def measurements(self) -> dict[str, float]:
        """Return estimated physical quantities by name, for the log."""
        return {} if self.exposure is None else {"cameras.gain_spread": self.exposure.spread}


@register("camera", "given")
class GivenCamera(CameraModel):
    """Keep the cameras of the data set.

    Args:
        exposure: whether to estimate a gain for each training view and colour channel.
        appearance: size of the embedding of each training view, from which a smooth gain over its image is learned, in
            addition to its exposure; 0 for none.
    """

    def __init__(self, exposure: bool = False, appearance: Natural = 0) -> None:
        super().__init__(exposure, appearance)

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """Return the rays unchanged."""
        return rays
