"""A mesh with another unit, axes or position than the photographs is reported before training."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.media.body_settings import make_bodies
from nerfro.silhouettes.mesh_match import require_match
from tests.exact_silhouettes import cameras_around, photographed

OBJECT = trimesh.util.concatenate(
    [trimesh.creation.icosphere(2, 0.3), trimesh.creation.box((1, 0.2, 0.2)).apply_translation((0.9, 0, 0.1))]
)
SWAPPED = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module")
def views() -> Views:
    """Views of the object from all sides, with its silhouettes as masks."""
    photographs = photographed(OBJECT, cameras_around(9, 32))
    return Views(photographs.cameras, torch.zeros(9, 32, 32, 3), photographs.masks, [str(i) for i in range(9)])


@pytest.mark.parametrize(
    ("matrix", "shift", "message"),
    [
        (np.eye(3), (0, 0, 0), None),
        (0.01 * np.eye(3), (0, 0, 0), "only to 0%; the mesh scaled by 100 agrees"),
        (100 * np.eye(3), (0, 0, 0), "all cameras lie inside the object, which is .*; the mesh scaled by 0.01 agrees"),
        (SWAPPED, (0, 0, 0), r"the mesh with \(x, y, z\) replaced by \(x, z, -y\) agrees"),
        (np.eye(3), (50, 20, 0), r"the mesh moved by \[-(50|49\.9).*, -(20|19\.9).*, -?0.*\] agrees"),
    ],
    ids=["right", "small", "large", "axes", "place"],
)
def test_unit_axes_and_position_of_a_mesh_are_compared_with_the_masks(
    matrix: np.ndarray, shift: tuple[int, ...], message: str | None, views: Views, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    changed = trimesh.Trimesh(OBJECT.vertices @ matrix.T + shift, OBJECT.faces, process=False)
    changed.export(tmp_path / "mesh.ply")
    medium = make_bodies(str(tmp_path / "mesh.ply"), resolution=24, cache=False)
    try:
        require_match(medium, views)
        said = capsys.readouterr().out
    except NerfroError as error:
        said = str(error)
    assert said == "" if message is None else re.search(message, said), said
