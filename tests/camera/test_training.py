"""Disturbed poses and exposures in training: recovery, reports, scores, resumption, and gains seen by every loss."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn.functional import mse_loss

from benchmarks.cameras import disturbed
from nerfro.camera.base import Appearance, Exposure, fit_gain
from nerfro.camera.refined.refined import motion_between
from nerfro.core.light import to_linear, to_srgb
from nerfro.data.formats.transforms import BlenderData, NerfstudioData
from nerfro.evaluation.image_metrics import psnr
from nerfro.evaluation.results import read_metrics_json
from nerfro.files.images import save_png
from nerfro.geometry.mesh import load_mesh
from nerfro.losses.terms import Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.registry.registration import discover
from nerfro.silhouettes.silhouettes import mesh_silhouettes
from nerfro.testing import NUM_RAYS, example_batch, example_components
from nerfro.training.run_folder import load, load_checkpoint
from tests.ball_photographs import TRAINING, cameras, photographs, save
from tests.conftest import Runner, weights_of

discover()

# A scene of a few steps has slopes for cameras to go by.
LEARNED_SKY = ["optimizer.groups={background.*: {learning_rate: 0.1, start: 0}}", "optimizer.warmup_steps=0"]


def poses_in(file: Path) -> torch.Tensor:
    frames = json.loads(file.read_text("utf-8"))["frames"]
    return torch.tensor([frame["transform_matrix"][:3] for frame in frames], dtype=torch.float64)


@pytest.mark.slow
def test_training_recovers_disturbed_poses(train_here: Runner, tmp_path: Path) -> None:
    views = photographs([1.45])
    true = views.cameras
    moved = disturbed(true, math.radians(0.5), 0.01, 0)
    save(replace(views, cameras=replace(true, camera_to_world=moved.float())), tmp_path / "ball")
    options = ["camera=refined", *TRAINING, "trainer.max_steps=300", f"data.root={tmp_path / 'ball'}"]
    train_here(*options, f"hydra.run.dir={tmp_path / 'run'}")
    found = poses_in(tmp_path / "run" / "cameras.json")
    before, after = motion_between(true.camera_to_world, moved), motion_between(true.camera_to_world, found)
    # From 0.494 degrees, a quarter of a pixel, to 0.018; and from 0.934 % of the distance to 0.194.
    assert float(after[0].median()) < 0.1 * float(before[0].median())
    assert float(after[1].median()) < 0.35 * float(before[1].median())


@pytest.mark.slow
def test_training_recovers_exposure_gains(train_here: Runner, tmp_path: Path) -> None:
    views = photographs([1.45])
    logarithm = 0.3 * torch.randn(len(views), 3).clamp(-2, 0)  # darker, so that nothing saturates
    images = to_srgb(to_linear(views.images) * logarithm.exp()[:, None, None])
    save(replace(views, images=images), tmp_path / "ball")
    options = ["camera.exposure=true", *TRAINING, "trainer.max_steps=150", f"data.root={tmp_path / 'ball'}"]
    options += ["optimizer.groups={cameras.exposure: {learning_rate: 0.03}}"]
    train_here(*options, f"hydra.run.dir={tmp_path / 'run'}")
    frames = json.loads((tmp_path / "run" / "cameras.json").read_text("utf-8"))["frames"]
    found = torch.tensor([frame["gain"] for frame in frames]).log()
    error = found - (logarithm - logarithm.mean(0))
    # From 0.162 to 0.001.
    assert float(error.square().mean().sqrt()) < 0.15 * float(logarithm.std())
    metrics = read_metrics_json(tmp_path / "run" / "metrics.json")
    assert metrics.treatments["exposed"].mean("psnr") > metrics.result.mean("psnr") + 3


def test_test_view_treatments_are_reported_by_name(train: Runner, tmp_path: Path) -> None:
    options = ["camera=refined", "camera.lens=true", "camera.exposure=true", "phase.cameras={start: 0, every: 1}"]
    train(*options, *LEARNED_SKY, "trainer.max_steps=3")
    document = json.loads((tmp_path / "run" / "metrics.json").read_text("utf-8"))
    assert document["test_views"] == "as given"
    assert list(document["treatments"]) == ["aligned", "unexposed", "exposed"]
    read = read_metrics_json(tmp_path / "run" / "metrics.json")
    for name in ("aligned", "exposed"):
        assert read.treatments[name].mean("psnr") == pytest.approx(document["treatments"][name]["test"]["psnr"])
        assert (tmp_path / "run" / f"images_{name}" / "test_000.png").is_file()
    # The file of cameras is data in nerfstudio's format.
    folder = tmp_path / "data"
    folder.mkdir()
    text = (tmp_path / "run" / "cameras.json").read_text("utf-8")
    (folder / "transforms.json").write_text(text.replace('"file_path": "', f'"file_path": "{tmp_path}/run/'))
    source = NerfstudioData(str(folder), near=1.0, far=6.0, test_every=2)
    shown = source.load("train")
    poses = dict(zip((Path(n).name for n in shown.names), shown.cameras.camera_to_world, strict=True))
    frames = json.loads(text)["frames"]
    assert frames[0]["turned_degrees"] > 0
    assert frames[0]["shifted"] > 0
    assert len(frames[0]["gain"]) == 3
    for frame in frames:
        if Path(frame["file_path"]).name in poses:
            expected = torch.tensor(frame["transform_matrix"][:3])
            torch.testing.assert_close(poses[Path(frame["file_path"]).name], expected)


@pytest.mark.slow
def test_resumed_run_with_refined_cameras_equals_an_uninterrupted_run(train: Runner, tmp_path: Path) -> None:
    options = ["camera=refined", "camera.lens=true", "camera.exposure=true", "phase.cameras={start: 2, every: 2}"]
    options += ["evaluation=none", "optimizer.final_learning_rate=1e-2"]
    states = []
    for name, parts in (("whole", [6]), ("parted", [2, 6])):
        for i, steps in enumerate(parts):
            again = ["ckpt_path=last"] if i else []
            train(*options, *again, f"trainer.max_steps={steps}", f"hydra.run.dir={tmp_path / name}")
        states.append(weights_of(tmp_path / name))
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert float(states[0]["renderer.scene.camera.motion"].abs().max()) > 0
    assert float(states[0]["renderer.scene.camera.lens"].abs().max()) > 0
    assert float(states[0]["renderer.scene.camera.exposure.log_gain"].abs().max()) > 0


def test_cameras_are_aligned_by_sky_and_masks_before_training_and_priors_are_saved(
    train: Runner, tiny_scene: Path, tmp_path: Path
) -> None:
    options = ["camera=refined", "evaluation=none", "trainer.max_steps=1"]
    kept, cameras = [], []
    for masks in (False, True):
        if masks:
            shutil.copytree(tiny_scene, tmp_path / "scene")
            views, mesh = BlenderData(str(tiny_scene)).load("train"), load_mesh(tiny_scene / "mesh.ply")
            for number, mask in enumerate(mesh_silhouettes(mesh, views.cameras, 1)):
                picture = mask[..., None].float().expand(-1, -1, 3)
                save_png(tmp_path / "scene" / "masks" / "train" / f"r_{number}.png", picture)
            options.append(f"data.root={tmp_path / 'scene'}")
        folder = tmp_path / f"run_{masks}"
        train(*options, f"hydra.run.dir={folder}")
        cameras.append(load(folder, "cpu").renderer.scene.camera)
        kept.append(load_checkpoint(folder / "checkpoints" / "last.ckpt")[0]["callbacks"]["Schedule"])
    without, with_masks = cameras
    assert bool((without.motion[:, :3] != 0).all())
    assert not bool(without.motion[:, 3:].any())
    assert bool((with_masks.motion != 0).all())
    kept = [state["cameras"]["state"] for state in kept]
    assert list(kept[0]) == ["panorama"]
    assert list(kept[1]) == ["panorama", "outlines"]
    for prior, camera in ((kept[0]["panorama"], without), (kept[1]["outlines"], with_masks)):
        torch.testing.assert_close(prior["mean"], camera.parameter_vector())
        assert prior["information"].shape == (camera.parameter_vector().numel(),) * 2


def test_exposure_gains_need_linear_radiance(train: Runner) -> None:
    refused = train("camera.exposure=true", "model.colour=srgb", "trainer.max_steps=1", code=1).error
    assert "model.colour=linear" in refused


def test_gains_have_a_mean_of_one() -> None:
    exposure = Exposure()
    exposure.begin(cameras().select([0, 1, 2, 3, 4]))
    assert torch.equal(exposure.gains(), torch.ones(5, 3))
    torch.nn.init.normal_(exposure.log_gain, mean=3.0)
    torch.testing.assert_close(exposure.gains().log().mean(0), torch.zeros(3), rtol=0, atol=1e-6)


def test_gains_are_fitted_to_unsaturated_pixels() -> None:
    exposure, gains = Exposure(), torch.ones(5, 3)
    gains[:2] = torch.tensor([[0.5, 1.0, 2.0], [2.0, 1.0, 0.5]])
    exposure.begin(cameras().select([0, 1, 2, 3, 4]))  # without a pixel of the last view
    view, radiance = torch.arange(400) % 4, 0.9 * torch.rand(400, 3)
    photographed = (gains[view] * radiance).clamp(max=1)
    photographed[view == 2] = 0  # a black photograph has no gain
    exposure.fit(view, example_batch().rays, radiance, photographed)
    torch.testing.assert_close(exposure.gains(), gains)


def test_losses_use_exposed_renderings() -> None:
    model, batch = RefractiveModel(example_components()), example_batch()
    gain = torch.rand(NUM_RAYS, 3) + 0.5
    (rendering,) = model(batch.rays)
    exposed = rendering.exposed(gain)
    torch.testing.assert_close(exposed.radiance, gain * rendering.radiance)
    torch.testing.assert_close(exposed.background_radiance, gain * rendering.background_radiance)
    expected = mse_loss(model.scene.colour_space.to_srgb(gain * rendering.radiance), batch.rgb)
    torch.testing.assert_close(Photometric()([exposed], batch, model.scene), expected)


@pytest.mark.parametrize("factors", [(1.0, 1.0, 1.0), (0.4, 0.9, 1.7), (3.0, 0.2, 1.0)])
def test_fitted_gain_is_exact_despite_saturated_pixels(factors: tuple[float, ...]) -> None:
    radiance, gain = 1.5 * torch.rand(500, 3), torch.tensor(factors)
    found = fit_gain(
        RefractiveModel(example_components()).scene.colour_space.to_srgb,
        radiance,
        to_srgb(gain * radiance).clamp(max=1),
    )
    torch.testing.assert_close(found, gain, rtol=1e-4, atol=0)


def test_appearance_has_a_mean_of_one_at_each_position_in_the_image() -> None:
    taken, appearance = cameras().select([0, 1, 2, 3, 4]), Appearance(4)
    appearance.begin(taken)
    corner = [taken.image_rays(view)[:1] for view in range(5)]
    rays, views = type(corner[0]).joined(corner), torch.arange(5)
    assert torch.equal(appearance(views, rays), torch.ones(5, 3))
    torch.nn.init.normal_(appearance.embedding, mean=3.0)
    gains = appearance(views, rays)
    assert float(gains.detach().log().std()) > 0.1
    torch.testing.assert_close(gains.log().mean(0), torch.zeros(3), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_embeddings_explain_colour_casts_across_photographs_that_gains_do_not(
    train_here: Runner, tmp_path: Path
) -> None:
    """Each photograph is tinted along a direction of its own; other views keep the colours of the scene."""
    views = photographs([1.45])
    steps = torch.linspace(-1, 1, views.cameras.width)
    slopes = 0.4 * (2 * torch.rand(2, len(views), 1, 1, 3) - 1)
    casts = slopes[0] * steps[:, None] + slopes[1] * steps[:, None, None] - 0.8  # darker, so that nothing saturates
    save(replace(views, images=to_srgb(to_linear(views.images) * casts.exp())), tmp_path / "ball")
    clean, scores = to_srgb(to_linear(views.images) * casts.mean(0).exp()), {}
    for option in ("camera.exposure=true", "camera.appearance=8"):
        folder = tmp_path / option.partition("=")[0]
        options = [option, *TRAINING, "trainer.max_steps=300", f"data.root={tmp_path / 'ball'}"]
        train_here(*options, f"hydra.run.dir={folder}")
        scores[option] = float(psnr(load(folder).render(views.cameras).rgb.flatten(0, 1), clean.flatten(0, 1)))
    assert scores["camera.appearance=8"] > scores["camera.exposure=true"] + 3
