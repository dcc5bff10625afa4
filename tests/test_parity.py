"""Our modules against one forward and backward pass of the authors' code, recorded in reference_sphere.npz.

Set NERFRO_REFERENCE to compare with another recording of the same keys.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.types import Batch, Rays, Rendering
from nerfro.losses.base import Loss
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.eikonal import Eikonal
from nerfro.paper.hierarchical import Hierarchical
from nerfro.paper.nerf import NerfField, Skybox
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.registry.registration import create, discover, find
from nerfro.rendering import Components
from nerfro.testing import example_batch

discover()

RECORDING = Path(os.environ.get("NERFRO_REFERENCE", Path(__file__).parent / "reference_sphere.npz"))


@pytest.fixture(scope="module")
def recorded() -> dict[str, Tensor]:
    with np.load(RECORDING, allow_pickle=False) as file:
        return {key: torch.from_numpy(np.asarray(file[key])) for key in file.files}


@pytest.fixture(scope="module")
def medium(recorded: dict[str, Tensor]) -> VoxelGrid:
    size, sigma = recorded["kernel"].tolist()
    return VoxelGrid.from_occupancy(
        recorded["occupancy"], recorded["box"], float(recorded["n_object"]), int(size), sigma
    )


@pytest.fixture(scope="module")
def batch(recorded: dict[str, Tensor]) -> Batch:
    num_rays = len(recorded["origins"])
    near, far = (recorded[key].expand(num_rays) for key in ("near", "far"))
    rays = Rays(recorded["origins"], recorded["directions"], torch.zeros(num_rays), near, far)
    # The training cameras have one tile of directions, which is the recorded one.
    cameras: Any = Mock(spec=Cameras)
    cameras.tile.return_value = recorded["sky_patch_directions"]
    return replace(example_batch(num_rays), rays=rays, rgb=recorded["target_rgb"], cameras=cameras)


@pytest.fixture(scope="module")
def model(recorded: dict[str, Tensor], medium: VoxelGrid) -> RefractiveModel:
    num_coarse, steps = int(recorded["num_coarse"]), int(recorded["steps_per_coarse"])
    width = recorded["weight/coarse_mlp/Dense_0/kernel"].shape[1]
    view_width = recorded["weight/coarse_mlp/Dense_10/kernel"].shape[1]
    parts = Components(
        medium=medium,
        path_sampler=Eikonal("euler", num_coarse * steps),
        point_sampler=Hierarchical(num_coarse, int(recorded["num_fine"]), draw="vertices", offset=0.0),
        make_field=lambda: NerfField(width=width, view_width=view_width),
        background=Skybox(width=recorded["weight/bkgd_mlp/Dense_0/kernel"].shape[1]),
    )
    model = RefractiveModel(parts, background_direction="last_coarse", colour="srgb").eval()
    for name, layer in layers(model).items():
        layer.weight.data.copy_(recorded[f"weight/{name}/kernel"].T)
        layer.bias.data.copy_(recorded[f"weight/{name}/bias"])
    return model


@pytest.fixture(scope="module")
def renderings(model: RefractiveModel, batch: Batch) -> list[Rendering]:
    return model(batch.rays)


def layers(model: RefractiveModel) -> dict[str, nn.Linear]:
    """Our layers by the authors' names."""
    named: dict[str, nn.Linear] = {}
    for network, field in zip(("coarse_mlp", "fine_mlp"), model.scene.fields, strict=True):
        mlp = field.mlp
        for i, layer in enumerate((*mlp.trunk.layers, mlp.density, mlp.bottleneck, mlp.view, mlp.rgb)):
            named[f"{network}/Dense_{i}"] = layer
    for i, layer in enumerate((*model.scene.background.trunk.layers, model.scene.background.rgb)):
        named[f"bkgd_mlp/Dense_{i}"] = layer
    return named


def test_parity_of_the_smoothed_grid(recorded: dict[str, Tensor], medium: VoxelGrid) -> None:
    assert_close(medium.table[..., 0], recorded["n_smoothed"], 1e-5)


def test_parity_of_the_path(recorded: dict[str, Tensor], renderings: list[Rendering], medium: VoxelGrid) -> None:
    path = renderings[0].path
    assert_close(path.positions, recorded["path_positions"], 1e-4)
    assert_close(path.s, recorded["path_distances"], 1e-4)
    assert_close(path.directions, recorded["path_directions"], 1e-4)
    ior, gradient = medium(path.positions)
    assert_close(ior, recorded["path_ior"], 1e-4)
    # The gradient jumps from cell to cell of a 40^3 grid, so positions 1e-5 apart may see it differ by more.
    assert_close(gradient, recorded["path_ior_gradient"], 1e-3)


@pytest.mark.parametrize(("level", "name"), [(0, "coarse"), (1, "fine")])
def test_parity_of_the_rendering(
    level: int, name: str, recorded: dict[str, Tensor], renderings: list[Rendering]
) -> None:
    rendering = renderings[level]
    assert_close(rendering.radiance, recorded[f"{name}_rgb"], 1e-3)
    assert_close(rendering.transmittance, recorded[f"{name}_transmittance"][:, 0], 1e-3)
    assert_close(rendering.opacity, recorded[f"{name}_opacity"], 1e-3)


def test_parity_of_the_losses_and_their_gradients(
    recorded: dict[str, Tensor], renderings: list[Rendering], model: RefractiveModel, batch: Batch
) -> None:
    settings: dict[str, dict[str, Any]] = {
        "photometric": {},
        "background": {"weight": 0.025, "start": 0, "ramp": 0, "refracted_only": False},
        "smoothness": {"weight": 1.0, "start": 0, "tile_size": len(recorded["sky_patch_directions"])},
    }
    losses: dict[str, Loss] = {name: create(find("loss", name), options) for name, options in settings.items()}
    values = {name: loss(renderings, batch, model.scene) for name, loss in losses.items()}
    fine_only = losses["photometric"](renderings[1:], batch, model.scene)
    assert_relative(fine_only, recorded["loss_rgb_fine"], 1e-3)
    assert_relative(values["photometric"] - fine_only, recorded["loss_rgb_coarse"], 1e-3)
    assert_relative(values["background"], recorded["loss_boundary"], 1e-3)
    assert_relative(values["smoothness"], recorded["loss_smoothness"], 1e-3)
    total = sum(loss.weight_at(0) * values[name] for name, loss in losses.items())
    assert_relative(total, recorded["loss_total"], 1e-3)
    model.zero_grad()
    total.backward()
    for name, layer in layers(model).items():
        assert_relative(layer.weight.grad.norm(), recorded[f"gradnorm/{name}/kernel"], 1e-2)
        assert_relative(layer.bias.grad.norm(), recorded[f"gradnorm/{name}/bias"], 1e-2)


def assert_close(ours: Tensor, theirs: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(ours.detach(), theirs, rtol=0, atol=tolerance)


def assert_relative(ours: Tensor, theirs: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(ours.detach(), theirs, rtol=tolerance, atol=0)
