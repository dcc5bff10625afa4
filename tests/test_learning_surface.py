"""A surface that learns in training: its gradient, where it goes, where it is kept, and what cannot have one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import nerfro
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.media import displacement
from nerfro.media.displacement import Displacement
from nerfro.media.sdf_grid import SdfGrid
from nerfro.models.base import NerfModel
from nerfro.rays import Rays
from nerfro.samplers.snell import Snell
from nerfro.training.outlines import hold_outlines
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from tests.ball_photographs import BOX, RADIUS, SIZE, ball, cameras, mesh, photographs, sky, solid

TOO_SMALL = 0.03


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(displacement, "LEVELS", (6, 10))


def learning(radius: float = RADIUS) -> SdfGrid:
    """A ball whose surface learns."""
    medium = SdfGrid.from_distances(ball(radius)[None], BOX, [1.5], 0.01)
    medium.meshes = [mesh()]
    medium.let_surface_learn()
    return medium


def seen(medium: SdfGrid, rays: Rays) -> tuple[Tensor, Tensor]:
    """Colours of the sky through a medium, with gradients, and which rays have sound ones through two events."""
    path = Snell()(rays, medium)
    usable = path.refracted & Snell().steady(path, medium)
    return sky(Snell().refine(path, rays, medium).exit_directions), usable


def test_the_displacement_is_the_same_on_the_grid_and_between() -> None:
    moved = Displacement((21, 25, 31), BOX, 2.0)
    for values in moved.levels:
        torch.nn.init.normal_(values)
    axes = [torch.linspace(-0.9, 0.9, n) for n in (21, 25, 31)]
    places = torch.cartesian_prod(*axes)
    expected = moved()
    values, _ = moved.at(places)
    torch.testing.assert_close(values.view(21, 25, 31), expected, rtol=1e-4, atol=1e-4)
    inner = torch.rand(50, 3) - 0.5
    step = torch.tensor([0.0, 1e-3, 0.0])
    slope = (moved.at(inner + step)[0] - moved.at(inner - step)[0]) / 2e-3
    torch.testing.assert_close(moved.at(inner)[1][:, 1], slope, rtol=1e-2, atol=1e-1)
    assert torch.equal(moved(moved.state()), expected)


def test_colours_have_the_right_gradient_by_the_displacement() -> None:
    torch.manual_seed(0)
    rays, medium = cameras().image_rays(4), learning()
    along = [torch.randn_like(values) for values in medium.displacement.levels]
    colours, usable = seen(medium, rays)
    moved = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            for values, part in zip(medium.displacement.levels, along, strict=True):
                values.copy_(sign * 2e-4 * part)
            medium.settle()
            moved.append(seen(medium, rays)[0])
    expected = (moved[0] - moved[1]) / 4e-4
    weights = expected.sign() * usable[:, None]  # so that nothing cancels
    (weights * colours).sum().backward()
    gradients = [values.grad for values in medium.displacement.levels]
    found = sum(float((gradient * part).sum()) for gradient, part in zip(gradients, along, strict=True))  # type: ignore[operator]
    assert found > 100
    assert found == pytest.approx(float((weights * expected).sum()), rel=0.01)


def test_a_ball_that_is_too_small_grows_to_what_is_seen_through_it() -> None:
    medium, true = learning((1 - TOO_SMALL) * RADIUS), solid([1.5])
    views = [cameras().image_rays(view) for view in range(0, 30, 3)]
    shown = [sky(Snell()(rays, true).exit_directions) for rays in views]
    optimizer = torch.optim.Adam(medium.surface_parameters(), betas=(0.9, 0.99))
    for step in range(80):
        optimizer.param_groups[0]["lr"] = 2e-3 * (1 - step / 80)
        rays, target = views[step % 10], shown[step % 10]
        colours, usable = seen(medium, rays)
        optimizer.zero_grad()
        (colours - target)[usable].square().mean().backward()
        optimizer.step()
        medium.settle()
    places = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1) * RADIUS
    with torch.no_grad():
        off = medium.signed_distances(places)[0].abs()
    assert off.median() < 0.25 * TOO_SMALL * RADIUS  # which it was off by


def test_outlines_say_where_the_surface_belongs() -> None:
    small = learning()
    views = photographs([1.5])
    masks = mesh_silhouettes(mesh(), views.cameras, 1).float()
    small.meshes = [TriangleMesh(mesh().vertices * (1 - TOO_SMALL), mesh().faces)]
    hold_outlines(small, replace(views, masks=masks))
    assert small._held is not None
    _, outwards, accuracy = small._held
    assert float(outwards.median()) == pytest.approx(TOO_SMALL * RADIUS, rel=0.3)
    assert accuracy == pytest.approx(0.25 * 3 / (0.8 * SIZE), rel=0.1)
    priors = []
    for share in (0.0, 1.0, 2.0):
        with torch.no_grad():
            # Outwards as a whole: cubic B-splines of equal control points are constant.
            small.displacement.levels[0].fill_(share * TOO_SMALL * RADIUS / small.displacement.paces[0])
        priors.append(float(small.prior().detach()))  # type: ignore[union-attr]
    assert priors[1] < 0.9 * priors[0]
    assert priors[1] < 0.9 * priors[2]
    hold_outlines(small, views)  # no masks: what was given is right
    assert small._held[1].abs().max() == 0


@pytest.fixture
def learning_run(tiny_default_run: list[str]) -> list[str]:
    return [*tiny_default_run, "medium.learn_surface=true", "optimizer.surface_start=1",
            "optimizer.surface_learning_rate=1e-3", "optimizer.warmup_steps=0", "evaluation.every=0",
            "checkpoint.every_steps=3", "checkpoint.every_seconds=null"]  # fmt: skip


def test_a_run_keeps_the_surface_that_it_has_learned(
    train_here: Callable[..., Any], learning_run: list[str], tmp_path: Path
) -> None:
    done = train_here(*learning_run, "trainer.max_steps=6", f"hydra.run.dir={tmp_path / 'whole'}")
    assert done.code == 0, done.err
    scene = nerfro.load(tmp_path / "whole", device="cpu")
    medium = scene.model.medium
    assert isinstance(medium, SdfGrid)
    moved = medium._given - medium.distances
    assert moved.abs().max() > 1e-4
    torch.testing.assert_close(moved[0], medium.displacement())  # all that was learned is in what is traced
    written = load_mesh(tmp_path / "whole" / "surface.ply")
    (surface,) = scene.surface
    assert abs(medium.signed_distances(torch.from_numpy(written.vertices).float())[0]).max() < 1e-4
    assert len(written.faces) == len(surface.faces)


def test_a_run_that_goes_on_has_the_same_surface(
    train_here: Callable[..., Any], learning_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It is interrupted between two grids, in which the surface that is traced is not quite the learned one.
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train_here(*learning_run, "trainer.max_steps=11", f"hydra.run.dir={whole}").code == 0
    step = NerfModel.training_step

    def killed(model: NerfModel, *batch: Any) -> Any:
        if model.global_step == 8:
            raise RuntimeError("killed")
        return step(model, *batch)

    with monkeypatch.context() as patched:
        patched.setattr(NerfModel, "training_step", killed)
        assert train_here(*learning_run, "trainer.max_steps=11", f"hydra.run.dir={parts}").code == 1
    state = load_checkpoint(parts / LAST_CHECKPOINT)[0]["state_dict"]
    learned = torch.cat([state[f"medium.displacement.levels.{level}"].flatten() for level in range(2)])
    assert not torch.equal(learned, state["medium._settled"])
    on = train_here(*learning_run, "trainer.max_steps=11", f"hydra.run.dir={parts}", "ckpt_path=last")
    assert on.code == 0, on.err
    first, second = (load_checkpoint(folder / LAST_CHECKPOINT)[0]["state_dict"] for folder in (whole, parts))
    for name, values in first.items():
        assert torch.equal(values, second[name]), name


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["sampler.path.interface=mesh"], "take sampler/path=snell with sampler.path.interface=sdf"),
        (["sampler/path=eikonal"], "take sampler/path=snell with sampler.path.interface=sdf"),
        (["sampler/path=straight"], "take sampler/path=snell with sampler.path.interface=sdf"),
        (["medium=ball"], "learn_surface"),
    ],
)
def test_what_cannot_learn_a_surface_is_refused_at_once(
    train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path, options: list[str], told: str
) -> None:
    kept = [text for text in tiny_default_run if not (options == ["medium=ball"] and text.startswith("medium"))]
    done = train_here(*kept, *options, "medium.learn_surface=true", f"hydra.run.dir={tmp_path / 'run'}")
    assert done.code == 1
    assert told in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize("experiment", ["glass", "unknown", "refractive_room"])
def test_a_surface_learns_whatever_else_does(
    train_here: Callable[..., Any], learning_run: list[str], tmp_path: Path, experiment: str
) -> None:
    done = train_here(
        f"+experiment={experiment}", *learning_run, "trainer.max_steps=4", f"hydra.run.dir={tmp_path / 'run'}"
    )
    assert done.code == 0, done.err
    state = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)[0]["state_dict"]
    assert state["medium._settled"].abs().max() > 1e-4
    assert all(torch.isfinite(values).all() for values in state.values())
