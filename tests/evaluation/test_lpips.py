from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from nerfro.evaluation.perceptual import LpipsNetwork, published_weights
from nerfro.files.images import load_png
from tests.processes import printed_by


class Reference(NamedTuple):
    network: LpipsNetwork
    predictions: Tensor  # [B, H, W, 3]
    targets: Tensor
    results: dict[str, Tensor]


@pytest.fixture(scope="module")
def network() -> LpipsNetwork:
    return LpipsNetwork(published_weights())


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """The values of torchmetrics with the convolutions and heads that nerfro contains."""
    folder = tmp_path_factory.mktemp("published")
    torch.save([pictures(), dict(published_weights())], folder / "input.pt")
    program = Path(__file__).with_name("reference_lpips.py")
    printed_by(str(program), str(folder / "input.pt"), str(folder / "results.pt"))
    results = torch.load(folder / "results.pt", weights_only=True)
    predictions, targets = (images.movedim(1, -1) for images in pictures())
    return Reference(LpipsNetwork(published_weights()), predictions, targets, results)


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


@pytest.mark.parametrize(("prediction", "distance"), [("ex_p0", 0.72188), ("ex_p1", 0.13757)])
def test_example_of_the_authors_has_its_distance(network: LpipsNetwork, prediction: str, distance: float) -> None:
    """Values of the package lpips with AlexNet in single precision, for the images of its repository."""
    folder = Path(__file__).parent / "lpips"
    images = [load_png(folder / f"{name}.png") for name in (prediction, "ex_ref")]
    assert network(*images).item() == pytest.approx(distance, abs=5e-5)
