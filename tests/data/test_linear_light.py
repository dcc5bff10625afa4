"""Photographs in linear light: files of other programs, the loss, training, scores and refusals."""

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import OpenImageIO
import pytest
import tifffile
import torch
from PIL import Image

from nerfro.camera.base import fit_gain
from nerfro.capture.surroundings import divide_pixels
from nerfro.core.light import ColourSpace, encode_photograph, saturated, to_linear, to_srgb, tone_mapped
from nerfro.core.paths import resolve_path
from nerfro.data.formats.transforms import BlenderData
from nerfro.data.image_files import read_mask, read_rgb, read_size
from nerfro.data.lazy_images import LazyImages
from nerfro.data.pixel_store import PixelStore
from nerfro.evaluation.image_metrics import psnr
from nerfro.evaluation.scoring import write_error_sheet
from nerfro.files.images import round_to_8bit, write_radiance
from nerfro.geometry.mesh import load_mesh
from nerfro.poses.collection import list_photographs
from tests.conftest import Runner, refused

RADIANCE = np.random.default_rng(0).lognormal(-1, 2, (12, 16, 3)).astype(np.float32)
SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def read(path: Path, alpha: str = "drop") -> np.ndarray:
    """Linear radiance of a photograph."""
    return to_linear(read_rgb(path, alpha))


def write(path: Path, values: np.ndarray = RADIANCE) -> Path:
    """Write a file by another program than the one that reads it, except for OpenEXR."""
    if path.suffix == ".hdr":
        cv2.imwrite(str(path), values[..., ::-1])
    elif path.suffix == ".exr":
        write_radiance(path, values)
    else:
        tifffile.imwrite(path, values, photometric="rgb")
    return path


@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [("a.exr", np.float32, 2e-6), ("a.hdr", np.float32, 1 / 128), ("a.tif", np.float32, 2e-6),
     ("a.tiff", np.float16, 2e-3), ("a.TIF", np.float64, 2e-6)],
)  # fmt: skip
def test_radiance_above_one_survives_a_file(name: str, dtype: type, tolerance: float, tmp_path: Path) -> None:
    file = write(tmp_path / name, RADIANCE.astype(dtype))
    assert read_size(file) == (16, 12, 32)
    brightest = RADIANCE.max(-1, keepdims=True)
    np.testing.assert_allclose(read(file) / brightest, RADIANCE / brightest, atol=tolerance)
    assert read(file).max() > 10


def test_transparency_is_composited_in_linear_light(tmp_path: Path) -> None:
    opacity = np.random.default_rng(1).uniform(0.1, 1, (12, 16, 1)).astype(np.float32)
    for name, colours, kind in (("a.tif", RADIANCE, "unassalpha"), ("b.tif", RADIANCE * opacity, "assocalpha")):
        stored = np.concatenate([colours, opacity], -1)
        tifffile.imwrite(tmp_path / name, stored, photometric="rgb", extrasamples=[kind])
        for alpha, expected in (
            ("drop", RADIANCE), ("black", RADIANCE * opacity), ("white", RADIANCE * opacity + 1 - opacity)
        ):  # fmt: skip
            np.testing.assert_allclose(read(tmp_path / name, alpha), expected, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("factor", [2, 1.6])
def test_downscaled_photographs_are_means_of_radiance(factor: float, tmp_path: Path) -> None:
    values = RADIANCE.copy()
    values[:6, :8] = 1  # saturated
    write(tmp_path / "a.exr", values)
    Image.fromarray(np.full((12, 16, 3), 255, np.uint8)).save(tmp_path / "b.png")
    images = LazyImages.of([tmp_path / "a.exr", tmp_path / "b.png"], lambda path: read_rgb(path, "drop"), factor)
    image = images[0]
    assert to_linear(image).mean().item() == pytest.approx(values.mean(), rel=1e-5)
    assert bool(saturated(image[:3, :4]).all())
    assert bool(saturated(images[1]).all())
    numbers = torch.arange(image.shape[0] * image.shape[1])
    torch.testing.assert_close(PixelStore(images)[numbers], image.view(-1, 3))


def write_dng(path: Path, colours: np.ndarray, neutral: tuple[float, ...], orientation: int) -> Path:
    """Write the raw photograph of a sensor with sRGB primaries (RGGB, 14 bits, black 512) of linear colours."""
    sensor = 512 + (16383 - 512) * (colours * neutral)
    mosaic = sensor[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = sensor[0::2, 0::2, 0], sensor[1::2, 1::2, 2]
    ratios = [[number for value in values for number in (round(1e4 * value), 10**4)]
              for values in (np.linalg.inv(SRGB_TO_XYZ).ravel(), neutral)]  # fmt: skip
    tags = [(274, "H", 1, orientation), (33421, "H", 2, (2, 2)), (33422, "B", 4, bytes([0, 1, 1, 2])),
            (50706, "B", 4, bytes([1, 4, 0, 0])), (50708, "s", 0, "Camera"), (50714, "H", 1, 512),
            (50717, "H", 1, 16383), (50721, "2i", 9, ratios[0]), (50728, "2I", 3, ratios[1]),
            (50778, "H", 1, 21)]  # fmt: skip
    levels = mosaic.clip(0, 16383).astype(np.uint16)
    tifffile.imwrite(path, levels, photometric=32803, extratags=[(*tag, True) for tag in tags], metadata=None)
    return path


@pytest.mark.parametrize("brightness", [1.0, 0.25])
@pytest.mark.parametrize("orientation", [1, 6])
def test_raw_photographs_have_the_colours_of_the_white_balance(
    brightness: float, orientation: int, tmp_path: Path
) -> None:
    """The level of saturation, and not the brightest pixel, is 1; the image is turned as the camera was held."""
    pytest.importorskip("rawpy")
    colours = np.tile(np.array([0.2, 0.3, 0.1]), (64, 96, 1))
    colours[:, 48:] = [0.4, 0.2, 0.3]
    if brightness == 1:
        colours[:16, :16] = 5
    file = write_dng(tmp_path / "a.dng", brightness * colours, (0.5, 1.0, 0.8), orientation)
    image = read(file)
    assert read_size(file) == (*image.shape[1::-1], 32)
    upright = np.rot90(image, 1) if orientation == 6 else image
    np.testing.assert_allclose(upright[40, 20], [0.2 * brightness, 0.3 * brightness, 0.1 * brightness], rtol=5e-3)
    np.testing.assert_allclose(upright[40, 80], [0.4 * brightness, 0.2 * brightness, 0.3 * brightness], rtol=5e-3)
    assert bool((read_rgb(file, "drop") == 1).all(-1).sum() > 100) == (brightness == 1)


def test_raw_photographs_are_developed_without_adapting_to_the_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {}

    class Raw:
        sizes = SimpleNamespace(iwidth=16, iheight=12, flip=5)

        def __enter__(self) -> "Raw":
            return self

        def __exit__(self, *error: object) -> None:
            return None

        def postprocess(self, **settings: object) -> np.ndarray:
            options.update(settings)
            return np.full((16, 12, 3), 65534, np.uint16)

    monkeypatch.setitem(sys.modules, "rawpy", SimpleNamespace(imread=lambda path: Raw()))  # type: ignore[arg-type]
    (tmp_path / "a.NEF").write_bytes(b"raw")
    assert read_size(tmp_path / "a.NEF") == (12, 16, 32)
    assert bool((read_rgb(tmp_path / "a.NEF", "drop") == 1).all())
    expected = {"use_camera_wb": True, "no_auto_bright": True, "adjust_maximum_thr": 0.0, "gamma": (1, 1)}
    assert options == expected | {"output_bps": 16}
    monkeypatch.setitem(sys.modules, "rawpy", None)
    refused(r"a\.NEF needs rawpy .*; pip install 'nerfro\[capture\]', or convert", read_size, tmp_path / "a.NEF")


def test_loss_is_that_of_a_tone_curve_with_unbiased_minimum() -> None:
    """RawNeRF: the gradient is that of half the squared logarithm near the photograph; the mean radiance minimizes."""
    rgb = encode_photograph(torch.tensor([[0.01, 0.3, 40.0]]))
    radiance = (1.02 * to_linear(rgb)).requires_grad_()

    def curve(values: torch.Tensor) -> torch.Tensor:
        return 0.455 * (values + 0.0352).log()

    prediction, target = ColourSpace.HDR.prediction_and_target(radiance, rgb)
    (slope,) = torch.autograd.grad((prediction - target).square().sum(), radiance)
    (expected,) = torch.autograd.grad((curve(radiance) - curve(to_linear(rgb))).square().sum(), radiance)
    torch.testing.assert_close(slope, expected, rtol=0.02, atol=0)
    for value, limit in ((0.0, 12.92), (1.0, 1.055 / 2.4)):  # the slopes of sRGB
        assert 0.455 / (value + 0.0352) == pytest.approx(limit, rel=2e-3)
    noisy = torch.tensor([0.2, 0.4, 30.0])[:, None].expand(-1, 3)  # photographs of one point
    mean = noisy.mean(0, keepdim=True).clone().requires_grad_()
    prediction, target = ColourSpace.HDR.prediction_and_target(mean.expand(3, -1), encode_photograph(noisy))
    (slope,) = torch.autograd.grad((prediction - target).square().sum(), mean)
    assert slope.abs().max() < 1e-5


def test_saturated_pixels_are_lower_bounds_and_brighter_ones_are_not() -> None:
    rgb = encode_photograph(torch.tensor([[1.0, 1.0, 20.0]]))
    for colour_space in (ColourSpace.HDR, ColourSpace.LINEAR):
        prediction, target = colour_space.prediction_and_target(torch.tensor([[5.0, 0.5, 5.0]]), rgb)
        error = (prediction - target)[0]
        assert error[0].abs() < 1e-6
        assert error[1] < -0.1
        assert error[2] < -0.1
    radiance, target = torch.tensor([[0.5], [4.0], [30.0]]).expand(-1, 3), torch.tensor([[1.0], [1.0], [90.0]])
    gain = fit_gain(to_srgb, radiance, encode_photograph(target).expand(-1, 3))
    torch.testing.assert_close(gain, torch.full((3,), 3.0), rtol=1e-3, atol=0)


def in_linear_light(scene: Path, root: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Copy a scene with photographs in OpenEXR, of changed radiance."""
    (root / "train").parent.mkdir(exist_ok=True)
    for file in sorted(scene.rglob("*")):
        target = root / file.relative_to(scene)
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".png":
            levels = np.asarray(Image.open(file).convert("RGB"), np.float32) / 255
            write_radiance(target.with_suffix(".exr"), change(to_linear(levels)))
        elif file.is_file():
            target.write_bytes(file.read_bytes())
    return root


def test_views_know_linear_light_and_components_with_bounded_radiance_refuse_it(
    tiny_scene: Path, tiny_run: list[str], tiny_default_run: list[str], train_here: Runner, tmp_path: Path
) -> None:
    root = in_linear_light(tiny_scene, tmp_path / "hdr", lambda radiance: 20 * radiance)
    views, usual = (BlenderData(str(folder)).load("train") for folder in (root, tiny_scene))
    assert views.in_linear_light
    assert not usual.in_linear_light
    torch.testing.assert_close(to_linear(views.images[0]), 20 * to_linear(usual.images[0]))
    default = [value for value in tiny_default_run if not value.startswith("background.")]
    for options in (tiny_run, [*default, "model.colour=srgb"], [*default, "background=skybox"]):
        error = train_here(*options, f"data.root={root}", "trainer.max_steps=1", code=1).error
        assert "the photographs are in linear light and may exceed 1" in error


@pytest.mark.slow
def test_training_in_linear_light_shows_and_scores_highlights(
    tiny_default_run: list[str],
    tiny_scene: Path,
    train_here: Runner,
    run_here: Runner,
    evaluate_here: Runner,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = in_linear_light(tiny_scene, tmp_path / "hdr", lambda radiance: 20 * radiance)
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    options = f"data.root={root}", "trainer.max_steps=60", "field.unbounded=true", f"hydra.run.dir={run}"
    train_here(*tiny_default_run, *options)
    settings = (run / "config.yaml").read_text()
    assert "colour: hdr" in settings
    metrics = json.loads((run / "metrics.json").read_text())
    assert set(metrics["treatments"]) == {"tone_mapped"}
    run_here("render", f"checkpoint={run}", "views=test", "format=exr", "out=predicted", "subdivision.side=2")
    for number, view in enumerate(metrics["treatments"]["tone_mapped"]["views"]):
        shown = np.asarray(Image.open(run / f"images_tone_mapped/test_{number:03d}.png"))
        predicted = torch.from_numpy(read(tmp_path / f"predicted/test_{number:03d}.exr"))
        reference = torch.from_numpy(read(root / f"test/r_{number}.exr"))
        assert predicted.max() > 1.5
        np.testing.assert_allclose(shown / 255, tone_mapped(predicted), atol=1.1 / 255)
        expected = float(psnr(round_to_8bit(tone_mapped(predicted)), tone_mapped(reference)))
        assert view["psnr"] == pytest.approx(expected, abs=0.02)
        (tmp_path / f"predicted/test_{number:03d}.exr").rename(tmp_path / f"predicted/r_{number}.exr")
    evaluate_here("predictions=predicted", f"references={root / 'test'}", "out=scores")
    scored = json.loads((tmp_path / "scores/metrics.json").read_text())
    for name, treatment in (("psnr", scored["treatments"]["tone_mapped"]), ("clipped", scored)):
        same = metrics["treatments"]["tone_mapped"] if name == "psnr" else metrics
        assert treatment["test"]["psnr"] == pytest.approx(same["test"]["psnr"], abs=0.02)


def test_error_maps_agree_with_scores_of_clipped_images(tmp_path: Path) -> None:
    bright, white = torch.full((32, 32, 3), 3.0), torch.ones(32, 32, 3)
    for name, prediction in (("bright", bright), ("white", white)):
        write_error_sheet(tmp_path, name, prediction, bright, {})
    sheets = [(tmp_path / "errors" / f"{name}.png").read_bytes() for name in ("bright", "white")]
    assert sheets[0] == sheets[1]


def test_surroundings_of_the_object_are_clipped_like_their_model(tmp_path: Path) -> None:
    views = BlenderData("embedded:torus", downscale=4).load("test")
    images = views.images[:] * 3  # a display value of 3 is a radiance of 11
    pixels = divide_pixels(replace(views, images=images), load_mesh(resolve_path("embedded:torus/mesh.ply")))
    assert all(float(part.radiance.max()) == 1 for part in pixels)


def test_unusable_files_are_refused_in_one_line(tmp_path: Path) -> None:
    values = RADIANCE.copy()
    values[3, 4] = math.inf
    refused("some of its values are not finite", read, write(tmp_path / "inf.exr", values))
    refused("it has the channels Y, but R, G and B are needed", read, write(tmp_path / "y.exr", RADIANCE[..., :1]))
    (tmp_path / "none.hdr").write_bytes(b"none")
    for call in (read, read_size):
        refused(r"image .*none\.hdr cannot be read", call, tmp_path / "none.hdr")
        refused(r"gone\.exr does not exist", call, tmp_path / "gone.exr")
    spec = OpenImageIO.ImageSpec(16, 12, 3, OpenImageIO.FLOAT)
    spec.full_width, spec.x, spec.full_x = 32, 4, 0
    output = OpenImageIO.ImageOutput.create(str(tmp_path / "crop.exr"))
    assert output.open(str(tmp_path / "crop.exr"), spec)
    output.write_image(RADIANCE)
    output.close()
    refused("its data window differs from its display window", read_size, tmp_path / "crop.exr")
    tifffile.imwrite(tmp_path / "a.tif", RADIANCE, photometric="rgb", extratags=[(274, "H", 1, 6, True)])
    refused("it has orientation 6; save it with upright pixels", read_size, tmp_path / "a.tif")
    refused("convert EXR, HEIC and raw files to PNG", read_mask, write(tmp_path / "mask.exr"))
    (tmp_path / "photos").mkdir()
    write(tmp_path / "photos/a.exr")
    refused(r"holds no image, but \.exr files; allowed are \.png", list_photographs, tmp_path / "photos")
