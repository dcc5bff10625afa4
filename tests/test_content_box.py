"""The content's box from Eikonal Fields' file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from nerfro.errors import NerfroError
from nerfro.media.analytic import Vacuum
from nerfro.training.config import TrainConfig, _settle_content


def settled(path: Path) -> DictConfig:
    config = OmegaConf.structured(TrainConfig)
    config.content.box_file = str(path)
    _settle_content(config, Vacuum())
    return config.content


def test_box_is_centre_and_half_sides(tmp_path: Path) -> None:
    path = tmp_path / "bounding_box_vals.npy"
    np.save(path, [[0.5, -1.0, 2.0], [0.25, 0.5, 1.0]])
    content = settled(path)
    assert list(content.box_min) == [0.25, -1.5, 1.0]
    assert list(content.box_max) == [0.75, -0.5, 3.0]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([[0, 0, 0], [1, -1, 1]], "positive half sides"),
        ([[0, 0], [1, 1]], "2x3 numbers"),
        ([[0, 0, np.nan], [1, 1, 1]], "2x3 numbers"),
        (None, "does not exist"),
        ([["a"] * 3] * 2, "not a .npy of numbers"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, values: list | None, message: str) -> None:
    path = tmp_path / "box.npy"
    if values is not None:
        np.save(path, values)
    with pytest.raises(NerfroError, match=message):
        settled(path)
