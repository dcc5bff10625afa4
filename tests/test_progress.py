"""Work that may take long before training starts says how far it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from nerfro import progress


@pytest.mark.parametrize(
    ("options", "work"),
    [
        (["medium=voxel_grid", "sampler/path=eikonal", "medium.smoothing_size=5"], ["occupancy", "smoothing"]),
        (["medium=sdf_grid"], ["distances", "occupancy"]),
    ],
)
def test_pictures_and_grids_have_bars_once_they_take_long(
    options: list[str],
    work: list[str],
    train_here: Callable[..., Any],
    tiny_default_run: list[str],
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = [
        *tiny_default_run,
        *options,
        "medium.mesh=${data.root}/mesh.ply",
        "trainer.max_steps=1",
        "evaluation.every=0",
        "evaluation.subdivision.side=1",
    ]
    monkeypatch.setattr(progress, "DELAY", 1e9)
    quick = train_here(*run, f"hydra.run.dir={tmp_path / 'quick'}")
    assert quick.code == 0, quick.err
    assert not [name for name in ("reading", *work) if name in quick.err]
    monkeypatch.setattr(progress, "DELAY", 0)
    told = train_here(*run, f"hydra.run.dir={tmp_path / 'told'}")
    assert told.code == 0, told.err
    for name in ("reading", *work):
        assert f"{name}: 100%" in told.err
