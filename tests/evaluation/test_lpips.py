from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from nerfro.evaluation.perceptual import lpips, pretrained
from nerfro.registry.registration import discover
from tests.conftest import refused
from tests.processes import printed_by

discover()
CONVOLUTIONS, Lpips, LpipsNetwork = lpips.CONVOLUTIONS, lpips.Lpips, lpips.LpipsNetwork
load_lpips_network = lpips.load_lpips_network


class Reference(NamedTuple):
    network: LpipsNetwork
    predictions: Tensor  # [B, H, W, 3]
    targets: Tensor
    results: dict[str, Tensor]


def random_weights() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    weights = {}
    for layer in CONVOLUTIONS:
        fan_in = layer.channels_in * layer.kernel**2
        shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
        weights[f"{layer.key}.weight"] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
        weights[f"{layer.key}.bias"] = 0.1 * torch.randn(layer.channels, generator=generator)
    return weights


@pytest.fixture(scope="module")
def network() -> LpipsNetwork:
    return load_lpips_network(random_weights())


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """The values of torchmetrics, and our network with the same backbone and the published heads."""
    folder = tmp_path_factory.mktemp("published")
    torch.save(pictures(), folder / "pictures.pt")
    program = Path(__file__).with_name("reference_lpips.py")
    printed_by(str(program), str(folder / "pictures.pt"), str(folder / "results.pt"))
    results = torch.load(folder / "results.pt", weights_only=True)
    predictions, targets = (images.movedim(1, -1) for images in pictures())
    return Reference(load_lpips_network(results["backbone"]), predictions, targets, results)


def pictures() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    targets = torch.rand(3, 3, 67, 83, generator=generator)
    targets[0] = torch.linspace(0, 1, 83)  # a smooth picture too, not noise alone
    predictions = (targets + 0.2 * torch.randn(targets.shape, generator=generator)).clamp(0, 1)
    predictions[2] = targets[2].roll(5, dims=-1)
    return predictions, targets


def test_distance_and_map_match_torchmetrics(reference: Reference) -> None:
    compared = reference.predictions, reference.targets, reference.results["distances"], reference.results["maps"]
    for prediction, target, distance, distance_map in zip(*compared, strict=True):
        assert distance > 0.01  # a comparison of zeros would show nothing
        assert reference.network(prediction, target).item() == pytest.approx(distance.item(), abs=1e-6)
        found = reference.network.distance_map(prediction, target)
        torch.testing.assert_close(found, distance_map, atol=1e-6, rtol=0)


def test_distance_on_a_mask_is_the_mean_of_the_map_there(network: LpipsNetwork) -> None:
    prediction, target = torch.rand(2, 48, 40, 3, generator=torch.Generator().manual_seed(0))
    inside = torch.zeros(48, 40, dtype=torch.bool)
    inside[5:20, 7:30] = True
    expected = network.distance_map(prediction, target)[5:20, 7:30].mean()
    assert network(prediction, target, inside).item() == pytest.approx(expected.item(), abs=1e-7)


def test_network_is_neither_trained_nor_saved_with_a_model(network: LpipsNetwork) -> None:
    assert list(network.parameters()) == []
    assert network.state_dict() == {}


def test_missing_network_is_reported_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(pretrained, "unreachable", lambda url: "no cable")
    metric = Lpips()
    metric.prepare()
    reason = metric.missing
    assert reason.startswith("no weights; AlexNet is not in the cache of torch, and there is no network (no cable)")
    assert f" to {tmp_path}" in reason
    assert "\n" not in reason
    cache = tmp_path / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    torch.save(random_weights(), cache / "alexnet-owt-7be5be79.pth")
    metric.prepare()
    assert metric.missing is None
    assert isinstance(metric.network, LpipsNetwork)


def test_weights_of_another_network_are_refused() -> None:
    other = random_weights()
    other["features.3.weight"] = other["features.3.weight"][:, :3]
    refused(r"features\.3\.weight of shape \[192, 64, 5, 5\], found \[192, 3, 5, 5\]", load_lpips_network, other)
