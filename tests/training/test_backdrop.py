"""Detection of photographs that are cut out on one colour, which becomes the backdrop of the volume."""

from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from nerfro.losses.terms import find_backdrop
from tests.conftest import QUIET, Runner, repaint

GREY = 102 / 255


def photographs(num_views: int = 10, colour: float = GREY) -> torch.Tensor:
    """Textured squares in the middle of pictures of one colour."""
    pictures = torch.full((num_views, 16, 16, 3), colour)
    pictures[:, 4:12, 4:12] = torch.rand(num_views, 8, 8, 3)
    return pictures


def test_cut_out_photographs_are_detected_for_any_colour() -> None:
    for colour in (0.0, GREY, 1.0):
        assert find_backdrop(photographs(colour=colour)) == pytest.approx([colour] * 3)


def test_cropped_objects_and_rounding_are_tolerated() -> None:
    pictures = photographs()
    pictures[3, :, 8:] = torch.rand(16, 8, 3)
    pictures[5, 0, 0] += 1 / 255
    assert find_backdrop(pictures) == pytest.approx([GREY] * 3)


def test_photographs_of_rooms_have_no_backdrop() -> None:
    slope = torch.linspace(0.4, 0.6, 16)[None, :, None, None].expand(10, 16, 16, 3)
    assert find_backdrop(slope) is None
    noisy = photographs() + 0.02 * torch.randn(10, 16, 16, 3)
    assert find_backdrop(noisy) is None
    of_different_colours = photographs() * torch.linspace(0.5, 1, 10)[:, None, None, None]
    assert find_backdrop(of_different_colours) is None


def test_black_rim_of_a_lens_is_no_backdrop() -> None:
    pictures = torch.rand(10, 32, 32, 3)
    pictures[:, :2] = pictures[:, -2:] = 0
    pictures[:, :, :2] = pictures[:, :, -2:] = 0
    assert find_backdrop(pictures) is None


@pytest.fixture
def cut_out(tiny_scene: Path, tmp_path: Path) -> Path:
    """The tiny scene with photographs of its ball on grey."""
    row, column = np.mgrid[:16, :16] - 7.5
    outside = np.hypot(row, column)[..., None] > 3
    return repaint(tiny_scene, tmp_path / "cut_out", lambda levels: np.where(outside, np.uint8(102), levels))


@pytest.mark.parametrize(("options", "has_backdrop"), [([], True), (["loss.backdrop.weight=0"], False)])
def test_straight_rays_end_on_the_backdrop(
    train_here: Runner, cut_out: Path, tmp_path: Path, options: list[str], has_backdrop: bool
) -> None:
    run = tmp_path / "run"
    few = ["+experiment=straight", f"data.root={cut_out}", "trainer.max_steps=2", "batches.size=64", *QUIET]
    finished = train_here(*few, f"hydra.run.dir={run}", *options)
    assert ("plain backdrop (102, 102, 102)" in finished.out) == has_backdrop
    config = OmegaConf.load(run / "config.yaml")
    if has_backdrop:
        assert config.background.rgb == pytest.approx([((GREY + 0.055) / 1.055) ** 2.4] * 3, rel=1e-4)
        assert config.loss.backdrop.colour == pytest.approx([GREY] * 3)
    else:
        assert "rgb" not in config.background
