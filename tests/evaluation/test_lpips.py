import functools
import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation import pretrained
from nerfro.evaluation.lpips import ALEX, VGG, Backbone, LpipsNetwork, find_lpips_networks, load_lpips_network


class Reference(NamedTuple):
    network: LpipsNetwork
    predictions: Tensor  # [B, H, W, 3]
    targets: Tensor
    results: dict[str, Tensor]


def random_weights(backbone: Backbone) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    weights = {}
    for layer in backbone.layers:
        fan_in = layer.channels_in * layer.kernel**2
        shape = (layer.channels, layer.channels_in, layer.kernel, layer.kernel)
        weights[f"{layer.key}.weight"] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
        weights[f"{layer.key}.bias"] = 0.1 * torch.randn(layer.channels, generator=generator)
    return weights


@pytest.fixture(scope="module")
def network() -> LpipsNetwork:
    return load_lpips_network(ALEX, random_weights(ALEX))


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, dict]]:
    """The values of another package with both backbones, computed once."""

    @functools.lru_cache
    def compute(package: str) -> dict[str, dict]:
        folder = tmp_path_factory.mktemp(package)
        predictions, targets = pictures()
        torch.save({"predictions": predictions, "targets": targets}, folder / "pictures.pt")
        program = [sys.executable, str(Path(__file__).with_name("reference_lpips.py")), package]
        command = [*program, str(folder / "pictures.pt"), str(folder / "results.pt")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return torch.load(folder / "results.pt", weights_only=True)

    return compute


def pictures() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    targets = torch.rand(3, 3, 67, 83, generator=generator)
    targets[0] = torch.linspace(0, 1, 83)  # a smooth picture too, not noise alone
    predictions = (targets + 0.2 * torch.randn(targets.shape, generator=generator)).clamp(0, 1)
    predictions[2] = targets[2].roll(5, dims=-1)
    return predictions, targets


@pytest.fixture(scope="module", params=["torchmetrics alex", "torchmetrics vgg", "lpips alex", "lpips vgg"])
def reference(request: pytest.FixtureRequest, published: Callable[[str], dict[str, dict]]) -> Reference:
    """The other package's own values, and our network with the same backbone and the published heads."""
    package, backbone = request.param.split()
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed; pip install --no-deps {package}")
    results = published(package)[backbone]
    network = load_lpips_network({"alex": ALEX, "vgg": VGG}[backbone], results["backbone"])
    predictions, targets = pictures()
    return Reference(network, predictions.movedim(1, -1), targets.movedim(1, -1), results)


def test_distance_is_that_of_the_published_packages(reference: Reference) -> None:
    for prediction, target, expected in zip(
        reference.predictions, reference.targets, reference.results["distances"], strict=True
    ):
        assert expected > 0.01  # a comparison of zeros would show nothing
        assert reference.network(prediction, target).item() == pytest.approx(expected.item(), abs=1e-6)


@pytest.mark.parametrize("reference", ["lpips alex", "lpips vgg"], indirect=True)  # torchmetrics gives no maps
def test_distance_map_is_that_of_lpips(reference: Reference) -> None:
    for prediction, target, expected in zip(
        reference.predictions, reference.targets, reference.results["maps"], strict=True
    ):
        torch.testing.assert_close(reference.network.distance_map(prediction, target), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("backbone", [ALEX, VGG])
def test_heads_are_the_published_ones_to_the_last_bit(backbone: Backbone) -> None:
    installed = importlib.util.find_spec("lpips")
    if installed is None or installed.origin is None:
        pytest.skip("lpips is not installed; pip install --no-deps lpips")
    file = Path(installed.origin).with_name("weights") / "v0.1" / f"{backbone.heads}.pth"
    published = torch.load(file, map_location="cpu", weights_only=True)
    network = load_lpips_network(backbone, random_weights(backbone))
    assert len(published) == 5
    for i in range(5):
        assert torch.equal(network.get_buffer(f"head{i}"), published[f"lin{i}.model.1.weight"])


def test_distance_on_a_mask_is_the_mean_of_the_map_there(network: LpipsNetwork) -> None:
    prediction, target = torch.rand(2, 48, 40, 3, generator=torch.Generator().manual_seed(0))
    inside = torch.zeros(48, 40, dtype=torch.bool)
    inside[5:20, 7:30] = True
    expected = network.distance_map(prediction, target)[5:20, 7:30].mean()
    assert network(prediction, target, inside).item() == pytest.approx(expected.item(), abs=1e-7)


@pytest.mark.parametrize("backbone", [ALEX, VGG])
def test_smallest_picture_is_the_smallest_that_the_backbone_takes(backbone: Backbone) -> None:
    size = backbone.min_size
    network = load_lpips_network(backbone, random_weights(backbone))
    assert torch.isfinite(network(torch.rand(size, size, 3), torch.rand(size, size, 3)))
    with pytest.raises(NerfroError, match=f"at least {size} x {size} pixels"):
        network(torch.rand(size - 1, 64, 3), torch.rand(size - 1, 64, 3))
    network.backbone = backbone._replace(min_size=0)
    with pytest.raises(RuntimeError):  # the limit is not stricter than it must be
        network(torch.rand(size - 1, 64, 3), torch.rand(size - 1, 64, 3))


def test_distance_does_not_depend_on_mixed_precision(network: LpipsNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    prediction, target = torch.rand(2, 48, 48, 3, generator=generator)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = network(prediction, target)
    assert mixed.item() == network(prediction, target).item()


def test_model_that_holds_the_network_neither_trains_nor_stores_it(network: LpipsNetwork) -> None:
    assert list(network.parameters()) == []
    assert network.state_dict() == {}


def test_missing_networks_are_reported_with_the_reason(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    networks, reasons = find_lpips_networks(download=False)
    assert networks == {}
    assert reasons.keys() == {"lpips", "lpips_vgg"}
    for name, title in (("lpips", "AlexNet"), ("lpips_vgg", "VGG-16")):
        assert reasons[name].startswith(f"no weights; {title} is not in the cache of torch")
        assert f" to {tmp_path}" in reasons[name]
        assert "\n" not in reasons[name]


def test_vgg_is_taken_from_the_cache_but_never_fetched(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(pretrained, "unreachable", lambda url: "asked" if "vgg" in url else "no cable")
    networks, reasons = find_lpips_networks()
    assert networks == {}
    assert "no cable" in reasons["lpips"]
    assert "asked" not in reasons["lpips_vgg"]
    cache = tmp_path / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    torch.save(random_weights(VGG), cache / "vgg16-397923af.pth")
    networks, reasons = find_lpips_networks(download=False)
    assert list(networks) == ["lpips_vgg"]
    assert list(reasons) == ["lpips"]


def test_weights_of_another_network_are_refused() -> None:
    other = random_weights(ALEX)
    other["features.3.weight"] = other["features.3.weight"][:, :3]
    with pytest.raises(NerfroError, match=r"features\.3\.weight of shape \[192, 64, 5, 5\], found \[192, 3, 5, 5\]"):
        load_lpips_network(ALEX, other)
    with pytest.raises(NerfroError, match=r"use the published file of VGG-16"):
        load_lpips_network(VGG, random_weights(ALEX))
