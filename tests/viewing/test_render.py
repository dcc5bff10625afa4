"""`python -m nerfro.render`: its frames and films, resumption, and refused options."""

import functools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO
import pytest
import torch
from PIL import Image

from nerfro.core.cameras import Cameras
from nerfro.core.lens import coefficients
from nerfro.files.lat_long import save_lat_long
from nerfro.registry.registration import discover
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.camera_paths import transforms_document
from nerfro.viewing.film import write_film
from nerfro.viewing.render_request import RenderConfig, find_shots
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Runner, refused


@pytest.fixture
def render(scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_here: Runner) -> Runner:
    """The entry point in this process, on the scene in closed form."""
    (tmp_path / "a.ckpt").write_bytes(b"scene")
    monkeypatch.setattr("nerfro.pipeline.render.load", lambda run, device, root: scene)
    monkeypatch.chdir(tmp_path)
    return functools.partial(run_here, "render", "checkpoint=a.ckpt", "out=O", "resolution=16", "subdivision.side=1")


def read(path: str) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(float)


def frames_of_film(path: str) -> list[np.ndarray]:
    """Frames by OpenCV's decoder, as RGB."""
    film, frames = cv2.VideoCapture(path), []
    while True:
        there, frame = film.read()
        if not there:
            return frames
        frames.append(frame[..., ::-1].astype(float))


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(((one - other) / 255).__pow__(2).mean()))


def test_orbit_is_written_as_frames_and_films(render: Runner) -> None:
    render("path=orbit", "frames=4", "seconds=2", "film=[mp4,gif]", "resolution=[34,25]")
    stills = [read(f"O/frame_{number:04d}.png") for number in range(4)]
    assert {still.shape for still in stills} == {(25, 34, 3)}
    film = frames_of_film("O/film.mp4")
    assert [frame.shape for frame in film] == [(26, 34, 3)] * 4
    for frame, still in zip(film, stills, strict=True):
        assert psnr(frame[:25], still) > 22  # colours are stored at half the resolution
    assert cv2.VideoCapture("O/film.mp4").get(cv2.CAP_PROP_FPS) == pytest.approx(2)
    with Image.open("O/film.gif") as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (4, 500, 0)
        gif.seek(3)
        assert psnr(np.asarray(gif.convert("RGB"), float), stills[3]) > 25


@pytest.mark.parametrize("num_frames", [1, 90, 150, 200, 400])
def test_gif_has_the_requested_duration(num_frames: int, tmp_path: Path) -> None:
    frames = [tmp_path / f"{number}.png" for number in range(num_frames)]
    for number, frame in enumerate(frames):
        Image.new("RGB", (2, 2), (number % 256, number // 256, 0)).save(frame)
    discover()
    write_film(tmp_path / "film.gif", frames, 5.0)
    with Image.open(tmp_path / "film.gif") as gif:
        durations = []
        for number in range(gif.n_frames):  # type: ignore[attr-defined]
            gif.seek(number)
            durations.append(gif.info["duration"])
    assert sum(durations) == 5000
    assert min(durations) >= 20  # browsers slow down faster films


def test_frames_of_another_layer_are_refused_after_a_rendering_in_another_format(render: Runner) -> None:
    render("path=arc", "frames=2", "film=[]")
    render("path=arc", "frames=2", "what=depth", "format=exr")
    refused = render("path=arc", "frames=2", "what=depth", "film=[]", code=1).error
    assert "frame_0000.png belongs to another rendering" in refused
    assert "2 of 2 frames exist already" in render("path=arc", "frames=2", "film=[]").out


def test_interrupted_rendering_is_resumed_and_not_mixed_with_another(render: Runner) -> None:
    render("path=arc", "frames=3")
    whole = read("O/frame_0001.png")
    Path("O/frame_0001.png").unlink()
    kept = Path("O/frame_0000.png").stat().st_mtime_ns
    assert "2 of 3 frames exist already" in render("path=arc", "frames=3").out
    assert Path("O/frame_0000.png").stat().st_mtime_ns == kept
    np.testing.assert_array_equal(read("O/frame_0001.png"), whole)
    refused = render("path=arc", "frames=3", "azimuth=40", code=1).error
    assert "frame_0000.png belongs to another rendering; give another out=... or overwrite=true" in refused
    for damaged in ("", "{}", "[]", "null"):  # as a record of unknown frames
        Path("O/frames.json").write_text(damaged)
        assert "belongs to another rendering" in render("path=arc", "frames=3", code=1).error
    render("path=arc", "frames=3", "azimuth=40", "overwrite=true")
    assert not np.array_equal(read("O/frame_0001.png"), whole)


def test_still_from_numbers_shows_the_expected_content(render: Runner) -> None:
    render("position=[0,0,5]", "target=[0,0,0]", "fov=10", "what=inside", "resolution=8")
    # The ball's top is at z = 0.35, and its colour is 0.4 + 0.5 of the place.
    linear = np.array([0.4, 0.4, 0.4 + 0.5 * 0.34])
    middle = read("O/frame_0000.png")[4, 4] / 255
    np.testing.assert_allclose(middle, 1.055 * linear ** (1 / 2.4) - 0.055, atol=0.06)


def test_field_of_view_is_that_of_the_rays_through_a_distorting_lens(
    scene: TrainedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = replace(scene.cameras("test"), distortion=torch.tensor([coefficients([-0.25])] * 3))
    monkeypatch.setattr(TrainedScene, "cameras", lambda self, split: cameras)

    def shots(**options: Any) -> Cameras:
        return find_shots(RenderConfig(checkpoint="a.ckpt", views="test", **options), scene).cameras

    wide = shots(fov=60.0, resolution=24)
    assert shots(resolution=(24, 16)).height == 16
    both, sides = torch.zeros(2, dtype=torch.long), torch.tensor([0, 24])
    left, right = wide.rays(both, torch.tensor([12, 12]), sides, torch.zeros(2)).directions
    assert math.degrees(math.acos(float(left @ right))) == pytest.approx(60, abs=1e-3)
    # x - 0.25 x^3 grows up to x = 1.155, which is 49 degrees.
    refused("fov=110 is not allowed, because the lens distortion is invertible up to 98 degrees", shots, fov=110.0)
    refused("test_000: the lens distortion is not invertible everywhere in the image", shots, resolution=[8, 32])


@pytest.mark.parametrize("what", ["depth", "normals", "opacity", "exits", "glass", "inside", "sky"])
def test_every_layer_is_written_as_image_and_as_values(what: str, render: Runner, scene: TrainedScene) -> None:
    for form in ("png", "exr"):
        render("views=test:1", f"what={what}", f"format={form}")
    values = OpenImageIO.ImageBuf("O/test_001.exr").get_pixels().squeeze()
    camera = scene.cameras().select([1]).resized(16, 16)
    parts = {"glass": {"inside": False}, "inside": {"glass": False}, "sky": {"inside": False, "glass": False}}
    rendered = scene.with_(**parts.get(what, {})).render(camera, Subdivision())
    name = {"exits": "exit_directions"}.get(what, what if what not in parts else "radiance")
    np.testing.assert_allclose(values.reshape(16, 16, -1), getattr(rendered, name)[0].view(16, 16, -1), atol=1e-5)
    shown = read("O/test_001.png")
    assert shown.shape == (16, 16, 3)
    assert shown.std() > 5


def test_cameras_of_a_file_become_key_frames(render: Runner, scene: TrainedScene) -> None:
    document = transforms_document(scene.cameras("test"), ["0.png", "1.png", "2.png"])
    Path("keys.json").write_text(json.dumps(document))
    render("path=keys.json", "film=[]", "frames=5")
    assert len(list(Path("O").glob("frame_*.png"))) == 5
    key, between = read("O/frame_0002.png"), read("O/frame_0003.png")
    render("views=test:1", "overwrite=true")
    assert psnr(key, read("O/test_001.png")) > 40
    assert psnr(between, read("O/test_001.png")) < 30


def test_another_sky_replaces_the_sky_of_the_scene(render: Runner) -> None:
    save_lat_long("light.hdr", torch.full((16, 32, 3), 0.5))
    render("views=test:0", "what=sky", "sky=light.hdr")
    np.testing.assert_allclose(read("O/test_000.png"), 255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055), atol=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "0 options select the cameras (); give exactly one of path=orbit"),
        (["path=orbit", "views=test"], "2 options select the cameras (path, views)"),
        (["path=loop"], "path=loop is not known; give orbit, spiral, arc, dolly"),
        (["path=nowhere.json"], "nowhere.json does not exist"),
        (["views=test:9"], "test has views 0 to 2"),
        (["views=test", "frames=9"], "frames=9 has no effect on still images; remove it"),
        (["position=[0,0,5]", "azimuth=30"], "azimuth=30.0 has no effect without path="),
        (["views=test", "film=[gif]"], "film=['gif'] has no effect on still images; remove it"),
        (["path=orbit", "format=exr", "film=[gif]"], "has no effect with format=exr"),
        (["position=[1,2]"], "position=[1.0, 2.0] is no point"),
        (["target=[0,0,0]", "views=test"], "needs position=[X,Y,Z]"),
        (["position=[1,0,4]", "target=[1,0,4]"], "a camera lies at its target"),
        (["views=test", "format=bmp"], "format='bmp' is not allowed; choose 'png', 'exr'"),
        (["views=test", "resolution=[1,2,3]"], "resolution=[1, 2, 3] is not allowed"),
        (["views=test", "sky=gone.hdr"], "the sky gone.hdr does not exist"),
        (["path=orbit", "fov=190"], "fov=190 is not allowed; take more than 0 and less than 180"),
    ],
)
def test_impossible_renderings_are_refused_in_one_line(arguments: list[str], message: str, render: Runner) -> None:
    assert message in render(*arguments, code=1).error
    assert not Path("O").exists()


def test_missing_ffmpeg_is_reported_before_frames_are_rendered(render: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refused = render("path=orbit", "frames=2", "resolution=16", code=1).error
    assert "needs ffmpeg, which is not installed; install ffmpeg, or pip install 'nerfro[video]'" in refused
    assert not Path("O").exists()
