import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation import lpips as ours
from nerfro.evaluation.lpips import LearnedPerceptualSimilarity, LpipsNetwork, find_lpips_network, load_lpips_network


class Reference(NamedTuple):
    network: LpipsNetwork
    predictions: Tensor  # [B, H, W, 3]
    targets: Tensor
    results: dict[str, Tensor]


def random_backbone() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    weights = {}
    for layer in ours.ALEXNET:
        fan_in = layer.channels_in * layer.kernel**2
        shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
        weights[f"{layer.key}.weight"] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
        weights[f"{layer.key}.bias"] = 0.1 * torch.randn(layer.channels, generator=generator)
    return weights


@pytest.fixture(scope="module")
def backbone_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("backbone") / "alexnet.pth"
    torch.save(random_backbone(), path)
    return path


@pytest.fixture(scope="module")
def network(backbone_file: Path) -> LpipsNetwork:
    return load_lpips_network(backbone_file)


@pytest.fixture(scope="module", params=["torchmetrics", "lpips"])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """The other package's own values, and our network with the same backbone and the published heads."""
    if importlib.util.find_spec(request.param) is None:
        pytest.skip(f"{request.param} is not installed; pip install --no-deps {request.param}")
    folder = tmp_path_factory.mktemp(request.param)
    generator = torch.Generator().manual_seed(0)
    targets = torch.rand(3, 3, 67, 83, generator=generator)
    targets[0] = torch.linspace(0, 1, 83)  # a smooth picture too, not noise alone
    predictions = (targets + 0.2 * torch.randn(targets.shape, generator=generator)).clamp(0, 1)
    predictions[2] = targets[2].roll(5, dims=-1)
    torch.save({"predictions": predictions, "targets": targets}, folder / "pictures.pt")
    program = Path(__file__).with_name("reference_lpips.py")
    command = [sys.executable, str(program), request.param, str(folder / "pictures.pt"), str(folder / "results.pt")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = torch.load(folder / "results.pt", weights_only=True)
    torch.save(results.pop("backbone"), folder / "backbone.pth")
    network = load_lpips_network(folder / "backbone.pth")
    return Reference(network, predictions.movedim(1, -1), targets.movedim(1, -1), results)


def test_distance_is_that_of_the_published_packages(reference: Reference) -> None:
    metric = LearnedPerceptualSimilarity(reference.network)
    for prediction, target, expected in zip(
        reference.predictions, reference.targets, reference.results["distances"], strict=True
    ):
        assert expected > 0.01  # a comparison of zeros would show nothing
        assert reference.network(prediction, target).item() == pytest.approx(expected.item(), abs=1e-6)
        metric.update(prediction, target)
    assert metric.compute().item() == pytest.approx(reference.results["mean"].item(), abs=1e-6)


@pytest.mark.parametrize("reference", ["lpips"], indirect=True)  # the only one with a public metric that has maps
def test_distance_map_is_that_of_lpips(reference: Reference) -> None:
    for prediction, target, expected in zip(
        reference.predictions, reference.targets, reference.results["maps"], strict=True
    ):
        torch.testing.assert_close(reference.network.distance_map(prediction, target), expected, atol=1e-6, rtol=0)


def test_equal_pictures_have_distance_zero(network: LpipsNetwork) -> None:
    picture = torch.rand(40, 50, 3)
    assert network(picture, picture).item() == 0
    assert network.distance_map(picture, picture).abs().max().item() == 0


def test_distance_map_is_large_where_pictures_differ(network: LpipsNetwork) -> None:
    target = torch.full((128, 128, 3), 0.5)
    prediction = target.clone()
    prediction[:32, :32] = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    distances = network.distance_map(prediction, target)
    assert distances.shape == (128, 128)
    assert distances[:32, :32].mean() > 10 * distances[96:, 96:].mean()


def test_smallest_picture_is_the_smallest_that_alexnet_takes(network: LpipsNetwork, monkeypatch) -> None:
    size = ours.MIN_PICTURE_SIZE
    assert torch.isfinite(network(torch.rand(size, size, 3), torch.rand(size, size, 3)))
    with pytest.raises(NerfroError, match="at least 31 x 31 pixels"):
        network(torch.rand(size - 1, 64, 3), torch.rand(size - 1, 64, 3))
    monkeypatch.setattr(ours, "MIN_PICTURE_SIZE", 0)
    with pytest.raises(RuntimeError):  # the limit is not stricter than it must be
        network(torch.rand(size - 1, 64, 3), torch.rand(size - 1, 64, 3))


def test_distance_does_not_depend_on_mixed_precision(network: LpipsNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    prediction, target = torch.rand(2, 48, 48, 3, generator=generator)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = network(prediction, target)
    assert mixed.item() == network(prediction, target).item()


def test_model_that_holds_the_network_neither_trains_nor_stores_it(network: LpipsNetwork) -> None:
    metric = LearnedPerceptualSimilarity(network)
    assert list(metric.parameters()) == []
    assert metric.state_dict() == {}


def test_missing_network_is_reported_with_the_reason(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    network, reason = find_lpips_network(download=False)
    assert network is None
    assert str(tmp_path) in reason
    assert "\n" not in reason


def test_named_backbone_is_never_passed_over(tmp_path: Path, backbone_file: Path) -> None:
    with pytest.raises(NerfroError, match="do not exist"):
        find_lpips_network(tmp_path / "nothing.pth")
    other = random_backbone()
    other["features.3.weight"] = other["features.3.weight"][:, :3]
    torch.save(other, tmp_path / "other.pth")
    with pytest.raises(NerfroError, match=r"features\.3\.weight of shape \[192, 64, 5, 5\], found \[192, 3, 5, 5\]"):
        find_lpips_network(tmp_path / "other.pth")
    network, reason = find_lpips_network(backbone_file)
    assert network is not None
    assert reason == ""
