"""A spoiled surface, mended by what is seen through it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from nerfro.capture import refined_mesh
from nerfro.capture.learned_distance import LearnedDistance
from nerfro.capture.refined_mesh import UNFINISHED, refine_mesh
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.capture.surface_refinement import OutlinePixels
from nerfro.capture.visual_hull import Silhouettes
from nerfro.geometry.mesh import TriangleMesh
from tests.ball_photographs import RADIUS, mesh, photographs

STEPS = 60


def outlines() -> Silhouettes:
    cameras = photographs([1.5]).cameras
    return Silhouettes.of(cameras, mesh_silhouettes(mesh(), cameras, 1).float())


def dented() -> TriangleMesh:
    """The ball with waves of 1.5 % of its radius."""
    ball = mesh()
    waves = np.sin(6 * ball.vertices @ np.array([0.5, 0.7, 0.5])) * np.cos(5 * ball.vertices[:, 0])
    return TriangleMesh(ball.vertices * (1 + 0.015 * waves[:, None]), ball.faces)


def dents(surface: TriangleMesh) -> float:
    """Standard deviation of the radius."""
    return float(np.linalg.norm(surface.vertices, axis=1).std())


def test_a_grid_at_rest_is_the_mesh_it_came_from() -> None:
    found = LearnedDistance(mesh(), 24).mesh()
    assert found.is_closed
    assert np.linalg.norm(found.vertices, axis=1) == pytest.approx(RADIUS, abs=0.004)


def test_outlines_know_which_way_a_surface_is_off() -> None:
    pixels, distance = OutlinePixels(outlines()), LearnedDistance(mesh(), 24)

    def misfit(thickness: float) -> float:
        """Of the ball with a coat."""
        offset = torch.full_like(distance.given, -thickness)
        return float(pixels.misfit(distance.medium([1.5], offset), torch.Generator().manual_seed(0)))

    at_rest, thick, thin = misfit(0.0), misfit(0.04), misfit(-0.04)
    assert at_rest < 0.1
    assert min(thick, thin) > at_rest + 0.2


def test_smoothing_costs_no_more_at_a_sharp_edge() -> None:
    distance = LearnedDistance(mesh(), 24)
    x = torch.linspace(-1, 1, len(distance.given))[:, None, None].expand_as(distance.given)
    assert float(distance.roughness(0.3 * x)) == pytest.approx(0, abs=1e-4)
    gentle, sharp = distance.roughness(0.1 * x.abs()), distance.roughness(10 * x.abs())
    assert 0 < gentle < sharp
    assert sharp < 2 / len(x) * 20


@pytest.mark.slow
def test_dents_are_mended_and_an_interrupted_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refined_mesh, "_STAGES", ((40, STEPS, 2),))
    views, start = photographs([1.5]), dented()

    def run(folder: Path) -> TriangleMesh:
        folder.mkdir(exist_ok=True)
        return refine_mesh(views, start, outlines(), 1.5, False, 32, folder)

    whole = run(tmp_path / "whole")
    assert dents(whole) < 0.6 * dents(LearnedDistance(start, 32).mesh())
    assert not (tmp_path / "whole" / UNFINISHED).exists()

    def interrupt(*arguments: object) -> None:
        save(*arguments)
        raise KeyboardInterrupt

    save = refined_mesh.save_arrays
    monkeypatch.setattr(refined_mesh, "save_arrays", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts")
    monkeypatch.setattr(refined_mesh, "save_arrays", save)
    assert (tmp_path / "parts" / UNFINISHED).is_file()
    assert dents(run(tmp_path / "parts")) < 0.7 * dents(LearnedDistance(start, 32).mesh())
