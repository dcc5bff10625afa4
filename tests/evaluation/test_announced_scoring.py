"""The line before a training that says how long the scores will take."""

import itertools
from dataclasses import replace

import pytest
import torch

from nerfro.evaluation import scoring
from nerfro.evaluation.scoring import ImageMetrics
from nerfro.models.refractive import RefractiveModel
from nerfro.samplers.subdivision import Subdivision
from nerfro.testing.examples import example_components, example_views


@pytest.mark.parametrize(("seconds", "line"), [(1.0, "about 1 min 20 s"), (0.05, "")])
def test_time_of_scoring_is_announced(
    seconds: float, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each of 20 views has four times the pixels of the small rendering, which takes `seconds`."""
    ticks = itertools.count()
    monkeypatch.setattr(scoring.time, "perf_counter", lambda: seconds * next(ticks))
    one = example_views().select([0])
    cameras = type(one.cameras).joined([one.cameras.resized(16, 16)] * 20)
    views = replace(one, cameras=cameras, images=torch.zeros(20, 16, 16, 3), names=[str(view) for view in range(20)])
    renderer = RefractiveModel(example_components()).eval()
    scoring.announce_scoring(renderer, views, ImageMetrics(["psnr"]), Subdivision(1), num_pixels=64)
    printed = capsys.readouterr().out
    assert line in printed
    assert ("trainer.limit_test_batches=5" in printed) == bool(line)
