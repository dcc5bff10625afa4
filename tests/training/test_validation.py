"""Validation pixels, and the warning about overfitting."""

import csv
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from nerfro.camera.base import GivenCamera
from nerfro.core.light import ColourSpace, to_srgb
from nerfro.core.types import Rays, mean_per_pixel
from nerfro.data.base import Views
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.validation import ValidationPixels
from nerfro.rendering import RayTracer, Renderer, Scene
from nerfro.samplers.points.stratified import Stratified
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.callbacks import OverfittingWarning
from nerfro.training.data_module import RayDataModule, validation_interval
from nerfro.training.pixel_batches import PixelBatches
from tests.closed_forms import Ball
from tests.conftest import Runner, repaint
from tests.reference_tracer import Snell

LINE = "the model overfits"


@pytest.fixture
def noise(tiny_scene: Path, tmp_path: Path) -> Path:
    """The tiny scene with photographs that have nothing in common: each pixel black or white."""
    generator = np.random.default_rng(0)

    def paint(levels: np.ndarray) -> np.ndarray:
        return 255 * generator.integers(2, size=(16, 16, 1), dtype=np.uint8).repeat(3, -1)

    return repaint(tiny_scene, tmp_path / "noise", paint)


@pytest.fixture
def learn(train: Runner) -> Runner:
    """Trains along straight rays through a fine grid, long enough to know few photographs by heart."""
    box = ["content.box_min=[-1.6,-1.6,-1.6]", "content.box_max=[1.6,1.6,1.6]"]
    quick = ["batches.size=256", "optimizer.learning_rate=3e-2", "phase.background.steps=0", "evaluation.every=50"]
    parts = [
        "sampler/path=straight",
        "field.log2_table_size=14",
        "field.finest_resolution=64",
        "loss.background.weight=0",
    ]
    steps = ["trainer.max_steps=150", "evaluation.subdivision.side=1"]
    return functools.partial(train, *box, *quick, *parts, *steps)


@pytest.mark.slow
def test_overfitting_warns_once(learn: Runner, noise: Path, tmp_path: Path) -> None:
    finished = learn(f"data.root={noise}", "logger=tensorboard", "trainer.log_every_n_steps=1")
    warnings = [line for line in finished.out.splitlines() if LINE in line]
    assert len(warnings) == 1
    assert "docs/tutorials/photographs.md, Few photographs" in warnings[0]
    with (tmp_path / "run" / "csv" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    held = [float(row["val/psnr"]) for row in rows if row["val/psnr"]]
    assert len(held) == 15, "a validation every ten steps"
    training = [float(row["train/psnr"]) for row in rows if row["train/psnr"]]
    assert held[-1] + 4 < np.mean(training[-10:])


@pytest.mark.parametrize(
    ("validations", "warned"),
    [
        ([(20, 21), (20, 23.9), (20.1, 24.2), (20.1, 24.3), (20.1, 27)], [3]),  # 4 dB below, twice
        ([(20, 24.1), (20, 23), (20, 24.1), (20, 23)], []),  # never twice in succession
        ([(8, 9), (20, 21), (24, 27.9), (25, 28.9), (26, 29.9)], []),  # within 4 dB
    ],
)
def test_gap_in_two_successive_validations_is_overfitting(
    validations: list[tuple[float, float]], warned: list[int]
) -> None:
    warning = OverfittingWarning()
    assert [step for step, psnr in enumerate(validations) if warning.judge(step, *psnr) is not None] == warned


def test_resumed_run_does_not_repeat_the_warning() -> None:
    before, later, again = OverfittingWarning(), OverfittingWarning(), OverfittingWarning()
    assert before.judge(1, 21, 22) is None
    assert before.judge(2, 20, 24) is None
    later.load_state_dict(before.state_dict())
    expected = "20.0 dB after 3 steps, and was highest (21.0 dB) after 1; training PSNR is 25.0 dB"
    assert expected in (later.judge(3, 20, 25) or "")
    again.load_state_dict(later.state_dict())
    assert again.judge(4, 20, 26) is None


def test_validation_pixels_are_usable_and_constant(tiny_scene: Path) -> None:
    views = BlenderData(str(tiny_scene), near=2.0, far=6.0).load("val")
    usable = torch.zeros(2, 16, 16, dtype=torch.bool)
    usable[:, 3:7] = True
    masked = replace(views, usable=usable)
    one, other = ValidationPixels.of(masked), ValidationPixels.of(masked)
    assert torch.equal(one.index, other.index)
    assert len(one.index.unique()) == len(one.index) == usable.sum()
    assert bool(usable.flatten()[one.index].all())
    images = torch.stack(list(views.images)).view(-1, 3)
    assert torch.equal(one.rgb, images[one.index])
    rays = views.cameras.image_rays(1)
    found = one.rays(bending(), Subdivision())
    assert torch.allclose(found.rays.directions[-64:], rays.directions[one.index[-64:] - 256])


def bending() -> Any:
    """What is asked of a model that bends rays by a ball."""
    model = Mock(spec=Renderer, path_sampler=Snell(), point_sampler=Stratified())
    model.scene = Mock(
        Scene, device=torch.device("cpu"), medium=Ball(0.6, 1.5), colour_space=ColourSpace.LINEAR, camera=GivenCamera()
    )
    model.exit_directions = functools.partial(Renderer.exit_directions, model)
    return model


@pytest.mark.parametrize("contrast", [None, 0.015])
def test_validation_pixels_have_the_rays_of_training(contrast: float | None, tiny_scene: Path) -> None:
    views = BlenderData(str(tiny_scene), near=2.0, far=6.0).load("val")
    model = bending()
    batches = PixelBatches(views, 256, "single_image")
    batch = RayTracer(model, Subdivision(2, 8.0, contrast)).trace(batches.draw(0))
    watched = ValidationPixels.of(views)
    found = watched.rays(model, Subdivision(2, 8.0, contrast))
    trained = rays_of_pixels(batch.rays, batch.pixel_number[batch.ray_pixel])
    shown = rays_of_pixels(found.rays, watched.index[found.ray_pixel])
    assert all(torch.equal(trained[pixel], shown[pixel]) for pixel in trained)
    assert sum(len(directions) == 4 for directions in trained.values()) > (8 if contrast is None else 16)
    assert sum(len(directions) == 1 for directions in trained.values()) > 100


@pytest.mark.parametrize("side", [1, 2])
@pytest.mark.parametrize("learns", [False, True])
def test_validation_views_have_fitted_gains_if_exposures_learn(learns: bool, side: int, tiny_scene: Path) -> None:
    views = BlenderData(str(tiny_scene), near=2.0, far=6.0).load("val")
    watched, model = (
        ValidationPixels.of(Views(views.cameras.select([0, 0]), torch.rand(2, 16, 16, 3), None, ["a"])),
        bending(),
    )
    model.radiance = lambda rays: 0.3 + 0.2 * rays.directions
    model.scene.camera = GivenCamera(exposure=learns)
    rays = watched.rays(model, Subdivision(side, 8.0))
    shown = mean_per_pixel(model.radiance(rays.rays), rays.ray_pixel, len(watched.index))
    gains = torch.tensor([[0.7, 0.8, 0.9], [1.4, 1.2, 1.1]])[watched.index // 256]
    watched = replace(watched, rgb=to_srgb(gains * shown))
    found = float(watched.psnr(model, Subdivision(side, 8.0)))
    assert found > 80 if learns else 15 < found < 30


def rays_of_pixels(rays: Rays, index: torch.Tensor) -> dict[int, torch.Tensor]:
    """Directions of the rays of each pixel, by its number in the data set."""
    return {pixel: rays.directions[index == pixel] for pixel in index.tolist()}


@pytest.mark.parametrize(("every", "looks"), [(0, 0), (1, 1), (4, 1), (11, 2), (500, 100)])
def test_validations_are_five_times_as_frequent_as_images(every: int, looks: int, tiny_scene: Path) -> None:
    assert validation_interval(every) == looks
    if not every:
        return
    module = RayDataModule(Mock(spec=PixelBatches), BlenderData(str(tiny_scene), near=2.0, far=6.0).load("val"), every)
    shown = {}
    for step in range(looks, 10 * every + 1, looks):
        view = module.due_view(step)
        if view is not None:
            shown[step] = view
    assert len(shown) == 10
    assert list(shown.values()) == [1, 0] * 5, "one view after the other"
