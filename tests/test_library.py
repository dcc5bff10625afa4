"""`import nerfro` as a library: a run from its folder, and the optics alone."""

import inspect
import math
import pickle
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import nerfro
from nerfro.core.errors import NerfroError
from nerfro.files.images import load_png
from nerfro.training.run_folder import LAST_CHECKPOINT
from tests.closed_forms import ball_exits, beam
from tests.conftest import UTM, Runner, moved_mesh, refused
from tests.processes import printed_by


def test_importing_nerfro_does_not_import_large_packages() -> None:
    source = "import sys, nerfro; print(*(m for m in ('torch', 'numpy', 'numba', 'hydra') if m in sys.modules))"
    assert printed_by("-c", source).strip() == ""


def test_missing_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="No nerfro attribute lod"):
        _ = nerfro.lod
    assert {"TrainedScene", "bend", "load"} <= set(nerfro.__all__) <= {*dir(nerfro), "__version__"}
    for name in nerfro.__all__:
        assert getattr(nerfro, name) is not None


def test_functions_keep_their_names_beside_the_modules_of_commands(trained_run: Path, tmp_path: Path) -> None:
    import nerfro.export
    from nerfro.train import main

    for function in (nerfro.train, nerfro.calibrate, nerfro.export):
        assert inspect.isfunction(function)
        assert pickle.loads(pickle.dumps(function)) is function
    assert main.__module__ == "nerfro.train"
    for settings, message in (
        ({"resolutoin": 8}, "resolutoin is not a setting; did you mean resolution"),
        ({"resolution": 0}, "resolution=0 is not allowed"),
        ({"out": tmp_path / "sky.txt"}, r"sky\.txt is not a file of sky; it must end in"),
    ):
        refused(message, nerfro.export, trained_run, "sky", **{"out": tmp_path / "sky.hdr"} | settings)
    refused("out=... is missing", nerfro.export, trained_run, "sky")


def test_run_is_loaded_rendered_and_exported(trained_run: Path, tmp_path: Path, run_here: Runner) -> None:
    scene = nerfro.load(trained_run, device="cpu")
    cameras = scene.cameras("test")
    views = scene.render(cameras)
    rgb, depth, opacity, normals, exits, radiance = views
    num, height, width = len(cameras), cameras.height, cameras.width
    assert repr(views) == f"RenderedViews({num} of {width} x {height} pixels)"
    with urllib.request.urlopen(views._repr_html_().split('"')[1]) as file, Image.open(file) as image:
        assert image.size == (num * width, height)
    assert len(repr(scene)) < 300
    assert rgb.shape == normals.shape == exits.shape == radiance.shape == (num, height, width, 3)
    assert depth.shape == opacity.shape == (num, height, width)
    assert rgb.min() >= 0
    assert rgb.max() <= 1
    for view in range(num):
        written = load_png(trained_run / "images" / f"test_{view:03d}.png")
        torch.testing.assert_close(written, rgb[view], atol=0.5 / 255 + 1e-6, rtol=0)
    assert float(scene.ior) == 1.5
    program = (
        f"import sys, nerfro; scene = nerfro.load({str(trained_run)!r}, device='cpu'); "
        "scene.render(scene.cameras('test').select([0])); assert 'lightning' not in sys.modules"
    )
    printed_by("-c", program)
    refused(r"checkpoint .* does not exist", nerfro.load, tmp_path / "gone")

    sky = nerfro.export(trained_run / LAST_CHECKPOINT, "sky", tmp_path / "sky.hdr", device="cpu", resolution=8)
    assert sky.stat().st_size > 0
    common = f"checkpoint={trained_run}", "device=cpu", "resolution=8"
    run_here("export", *common, "what=sky", f"out={sky}", code=1)  # nothing is overwritten


def test_composition_imports_no_package_that_only_other_work_needs() -> None:
    arguments = ["train", "--cfg", "job", "+callbacks=early_stopping", "callbacks.early_stopping.monitor=val/psnr"]
    program = f"import sys; sys.argv = {arguments}; from nerfro.train import main; main()"
    slow = {
        "lightning",
        "torchmetrics",
        "trimesh",
        "matplotlib",
        "jinja2",
        "scipy.ndimage",
        "scipy.sparse",
        "skimage.metrics._structural_similarity",
    }
    printed_by("-c", f"{program}; assert not {slow} & set(sys.modules)")


@pytest.mark.slow
@pytest.mark.parametrize("interface", ["mesh", "sdf"])
def test_paths_through_a_ball_match_closed_form(interface: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    ball, heights = trimesh.creation.icosphere(5, 0.8), np.linspace(-0.7, 0.7, 15)
    origins = np.stack([0 * heights - 4, heights, 0 * heights], -1)
    near, *far = (
        nerfro.bend(
            moved_mesh(ball, place, tmp_path / "ball.obj"), 1.5, origins + place, np.tile([[2.0, 0, 0]], (15, 1)),
            interface, 64,
        )
        for place in ([0, 0, 0], [1e5, -2e5, 50], UTM)
    )  # fmt: skip
    bent = near
    for place, other in zip(([1e5, -2e5, 50], UTM), far, strict=True):
        turned = torch.linalg.vector_norm(other.directions - near.directions, dim=-1).max().rad2deg()
        assert turned < 0.01
        np.testing.assert_allclose(other.positions - torch.tensor(place), near.positions, atol=1e-4)
    expected = ball_exits(beam(torch.from_numpy(heights)), 0.8, 1.5)
    np.testing.assert_allclose(bent.directions, expected, atol=5e-3)
    assert bent.hit.all()
    # What is left on the way to the box is on the line that leaves the ball.
    beyond = torch.linalg.vector_norm(bent.positions, dim=-1)
    assert (beyond > 0.8).all()
    assert (bent.lengths > 4 - 0.8).all()


def test_rays_that_begin_on_a_face_of_a_slab_do_not_cross_the_face(tmp_path: Path) -> None:
    trimesh.creation.box((2, 2, 1)).export(tmp_path / "slab.ply")
    direction = np.array([0.5, 0, math.sqrt(0.75)])
    bent = nerfro.bend(tmp_path / "slab.ply", 1.5, [[0.1, 0.2, 0.5], [0.1, 0.2, -0.5]], [direction, direction])
    leaves_glass = torch.tensor([0.75, 0.0, math.sqrt(1 - 0.75**2)], dtype=torch.float64)
    assert bent.hit.tolist() == [False, True]
    torch.testing.assert_close(bent.directions[0].double(), torch.from_numpy(direction))
    torch.testing.assert_close(bent.directions[1].double(), leaves_glass, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("rays", "message"),
    [
        (([[0, 0, 0]], [[0, 0, 0]]), "no direction zero"),
        (([[0, 0, math.nan]], [[1, 0, 0]]), "must be finite"),
        (([0, 0, 0], [1, 0, 0]), "must both be"),
    ],
)
def test_invalid_rays_are_refused(rays: tuple, message: str, tmp_path: Path) -> None:
    refused(message, nerfro.bend, tmp_path / "ball.ply", 1.5, *rays)
    with pytest.raises(NerfroError, match="resolution=9 is not allowed; give at least 10"):
        nerfro.bend(tmp_path / "ball.ply", 1.5, [[0, 0, 0]], [[1, 0, 0]], resolution=9)


@pytest.mark.parametrize(
    ("experiment", "overrides", "message"),
    [
        ("refractive", ["fild=nerf"], "fild is not a setting; did you mean field"),
        ("refractiv", [], "experiment=refractiv does not exist; did you mean refractive"),
    ],
)
def test_misspelt_names_are_refused_as_on_the_command_line(experiment: str, overrides: list[str], message: str) -> None:
    refused(message, nerfro.build, experiment, overrides)
