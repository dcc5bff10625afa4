"""The page of a scene agrees with renderings of nerfro in a browser, its controls take effect, and its data survive."""

import base64
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from PIL import Image

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.core.light import to_linear
from nerfro.core.paths import resolve_path
from nerfro.core.types import Exits, FieldValues, Samples
from nerfro.core.variants import variant
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.image_metrics import psnr
from nerfro.fields.base import Field
from nerfro.files import lat_long
from nerfro.files.images import write_radiance
from nerfro.geometry.space import Contracted
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.samplers.subdivision import Subdivision
from nerfro.testing import example_draws
from nerfro.viewing.baking import bake_sky, cube_directions, pack, shared_exponent
from nerfro.viewing.page import make_page
from nerfro.viewing.trained_scene import TrainedScene, with_changed_scene
from tests.closed_forms import Luneburg, sampled
from tests.conftest import refused
from tests.media.vessels import GLASS, WATER, spherical_vessel
from tests.viewing.browser import SHOT, Browser, needs_chromium
from tests.viewing.conftest import IOR, RADIUS, sky_of

SET = """
const set = (id, value) => {
  if (typeof value === "boolean") $(id).checked = value;
  else $(id).value = value;
  $(id).dispatchEvent(new Event("input", { bubbles: true }));
};
"""


def picture(text: str) -> Float[torch.Tensor, "H W 3"]:
    pixels = np.frombuffer(base64.b64decode(text), np.uint8)
    size = math.isqrt(len(pixels) // 4)
    return torch.from_numpy(pixels.reshape(size, size, 4)[::-1, :, :3] / 255.0).float()


def ask(page: str, script: str, folder: Path) -> Any:
    """Evaluate an expression in a page."""
    with Browser(page, folder) as browser:
        return browser.evaluate(script)


def one_ray(scene: TrainedScene, cameras: Cameras | None = None) -> Float[torch.Tensor, "V H W 3"]:
    return scene.render(cameras or scene.cameras("test"), Subdivision()).rgb


def in_embedded_scene(scene: TrainedScene, medium: Bodies) -> TrainedScene:
    """The ball inside another medium, under the embedded scene's sky and seen by its cameras."""
    sky = EnvironmentMap([128], image=str(resolve_path("embedded:torus/sky.png")))
    renderer = with_changed_scene(scene.renderer, medium=medium, background=sky)
    return TrainedScene(renderer, BlenderData("embedded:torus", downscale=2))


@pytest.fixture
def glass_cube(scene: TrainedScene) -> TrainedScene:
    """The embedded scene's glass, sky and cameras around the ball inside, and a bubble in the glass; both disperse."""
    mesh = "embedded:torus/mesh.ply"
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    outer = make_bodies(mesh, resolution=64, box_min=[-1.5] * 3, box_max=[1.5] * 3, cache=False)
    axes = torch.stack(torch.meshgrid(*[torch.linspace(-1.5, 1.5, 64)] * 3, indexing="ij"), -1)
    bubble = torch.linalg.vector_norm(axes - torch.tensor([-0.3, -0.3, 0.2]), dim=-1) - 0.15
    medium = sampled([outer.grids[0].distances, bubble], box, [1.5, 1.05], outer.shell, abbe=8.0)
    return in_embedded_scene(scene, medium)


@pytest.mark.slow
@needs_chromium
def test_five_cameras_of_a_cube_with_bodies_inside_agree_with_nerfro(glass_cube: TrainedScene, tmp_path: Path) -> None:
    views = [0, 4, 8, 12, 16]
    page = make_page(glass_cube, 64)
    found = ask(page, f"(() => {{ {SHOT} return {views}.map((view) => shot(view, 64)); }})()", tmp_path)
    expected = one_ray(glass_cube, glass_cube.cameras("test").select(views))
    scores = [float(psnr(picture(shot), rgb)) for shot, rgb in zip(found, expected, strict=True)]
    assert min(scores) > 30, scores


@pytest.mark.slow
@needs_chromium
def test_vessel_agrees_with_nerfro(scene: TrainedScene, tmp_path: Path) -> None:
    walls, water = {"ior": GLASS, "absorption": [0.3, 1.0, 2.0]}, {"ior": WATER, "absorption": [1.0, 0.0, 0.5]}
    vessel = spherical_vessel(tmp_path, level=0.9, resolution=64, glass=walls, liquid=water)
    vessel_scene = in_embedded_scene(scene, vessel)
    # Dyed walls of index 1 absorb, another liquid changes the picture, and air has no index to change.
    code = f"""(() => {{ {SHOT}{SET}
      const seen = [shot(0, 64), shot(9, 64)];
      const indices = [...document.querySelectorAll("[id^=ior][type=range]")].map((slider) => slider.id);
      set(indices[0], 1.0);
      set(indices[1], 1.5);
      return {{ seen, indices, filled: shot(9, 64) }};
    }})()"""
    found = ask(make_page(vessel_scene, 64), code, tmp_path)
    assert found["indices"] == ["ior0", "ior2"]
    expected = one_ray(vessel_scene, vessel_scene.cameras("test").select([0, 9]))
    assert min(float(psnr(picture(shot), rgb)) for shot, rgb in zip(found["seen"], expected, strict=True)) > 30
    with_glass = vessel.with_indices(torch.tensor([1.0, 1.0, 1.5]))
    expected = one_ray(replace(vessel_scene, renderer=with_changed_scene(vessel_scene.renderer, medium=with_glass)),
                       vessel_scene.cameras("test").select([9]))  # fmt: skip
    assert psnr(picture(found["filled"]), expected[0]) > 30
    assert psnr(picture(found["filled"]), picture(found["seen"][1])) < 30


@needs_chromium
def test_interleaved_passes_equal_the_full_frame(scene: TrainedScene, tmp_path: Path) -> None:
    script = """(() => {
      const { gl, canvas } = page.tracer;
      [canvas.width, canvas.height] = [50, 38];
      page.camera = 0;
      const read = () => {
        const pixels = new Uint8Array(4 * 50 * 38);
        gl.readPixels(0, 0, 50, 38, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        return pixels;
      };
      const differences = (a, b) => a.filter((value, i) => value !== b[i]).length;
      page.drawOnce();
      const full = read();
      const found = [];
      for (let pass = 0; pass < 16; ++pass) {
        for (const rows of [[0, 4], [4, 10]]) {
          page.tracer.trace(page.view, readSettings(page.scene), [50, 38], { stride: 4, pass, rows });
        }
        page.tracer.show({ stride: 4, done: pass + 1 });
        found.push(differences(full, read()));
      }
      return found;
    })()"""
    differences = ask(make_page(scene, 32), script, tmp_path)
    assert differences[-1] == 0
    assert all(differences[:-1])
    assert differences[4] < differences[0]


@needs_chromium
def test_view_at_rest_is_traced_in_parts_at_full_resolution(scene: TrainedScene, tmp_path: Path) -> None:
    with Browser(make_page(scene, 16), tmp_path, size=(340, 120)) as browser:
        browser.evaluate("page.pixelDuration = 1")  # a slow machine, until it has traced a few parts
        browser.evaluate("page.changed()")
        browser.wait_for("page.stride === 4 && page.pass > 0")
        browser.wait_for("page.rays > 0", 200)
        size = browser.evaluate("[page.tracer.canvas.width, page.tracer.canvas.height]")
        assert browser.evaluate("$('frame').textContent").startswith(f"{size[0]} x {size[1]} pixels, ")


class Surroundings(Field):
    """Two soft coloured clouds: one beside the glass, and a large one far behind it."""

    def forward(self, samples: Samples) -> FieldValues:
        density = torch.zeros_like(samples.s)
        radiance = torch.zeros_like(samples.positions)
        clouds = (([0.9, 1.1, 0.2], 0.4, 6.0, [0.8, 0.2, 0.1]), ([-9.0, -1.0, 2.0], 4.0, 0.5, [0.1, 0.3, 0.9]))
        for centre, width, thickest, cloud in clouds:
            offset = samples.positions - torch.tensor(centre)
            of_cloud = thickest * torch.exp(-offset.square().sum(-1) / width**2)
            density += of_cloud
            radiance += of_cloud[..., None] * torch.tensor(cloud)
        return FieldValues(density, radiance / density[..., None].clamp(min=1e-9))


@pytest.mark.slow
@needs_chromium
def test_contracted_surroundings_are_shown(scene: TrainedScene, tmp_path: Path) -> None:
    space = Contracted([[-2.0] * 3, [2.0] * 3], 2.0, near=1.0)
    sampler = DensityGridSampler(space, 512, 256, resolution=48, update_fraction=0.9)
    field = Surroundings()
    for step in range(3):
        sampler.update([field], example_draws(step=step * sampler.update_every))
    renderer = with_changed_scene(scene.renderer, fields=torch.nn.ModuleList([field]), space=space)
    everywhere = replace(scene, renderer=variant(renderer, point_sampler=sampler))
    found = ask(
        make_page(everywhere, 96), f"(() => {{ {SHOT} return [0, 1, 2].map((v) => shot(v, 32)); }})()", tmp_path
    )
    expected, without = one_ray(everywhere), one_ray(everywhere.with_(inside=False))
    for shot, rgb, empty in zip(found, expected, without, strict=True):
        assert float(psnr(picture(shot), rgb)) > 33
        assert float(psnr(empty, rgb)) < 28, "the surroundings are much of what is seen"


@pytest.mark.slow
@needs_chromium
def test_controls_change_index_glass_reflection_tint_and_sky(scene: TrainedScene, tmp_path: Path) -> None:
    lamp = lat_long.directions(32)
    lamp = 4 * (lamp[..., 2:] > 0.5) * torch.tensor([1.0, 0.5, 0.1]) + 0.1
    write_radiance(tmp_path / "lamp.hdr", lamp.numpy())
    hdr = base64.b64encode((tmp_path / "lamp.hdr").read_bytes()).decode()
    script = f"""(() => {{
      {SHOT}{SET}
      const shots = {{ start: shot(0, 32) }};
      set("ior0", 1.6); shots.index = shot(0, 32); const said = $("ior0-value").value; set("ior0", {IOR});
      set("straight", 0.5); shots.half = shot(0, 32); set("straight", 1); shots.glass = shot(0, 32); set("straight", 0);
      set("reflection", true); shots.reflection = shot(0, 32); set("reflection", false);
      set("tint", 1); set("tint-colour", "#804000"); shots.tint = shot(0, 32); set("tint", 0);
      const bytes = Uint8Array.from(atob("{hdr}"), (character) => character.charCodeAt(0));
      page.tracer.setPicture(decodeHdr(bytes)); shots.sky = shot(0, 32); page.tracer.setPicture(null);
      shots.end = shot(0, 32);
      for (const button of document.querySelectorAll("#cameras button")) if (button.value === "1") button.click();
      return {{ shots, said, camera: page.camera, photograph: !$("photograph").hidden, alt: $("photograph").alt,
        unnamed: [...document.querySelectorAll("input, canvas")].filter((e) => !e.labels?.length && !e.ariaLabel)
          .length }};
    }})()"""
    found = ask(make_page(scene, 48), script, tmp_path)
    shots = {name: picture(text) for name, text in found["shots"].items()}

    def agrees(name: str, changed: TrainedScene) -> bool:
        return float(psnr(shots[name], one_ray(changed)[0])) > 30

    assert agrees("start", scene)
    assert agrees("index", scene.with_(ior=1.6))
    assert not agrees("index", scene)
    assert found["said"] == "1.60"
    assert agrees("glass", scene.with_(glass=False))
    torch.testing.assert_close(shots["half"][:, :16], shots["glass"][:, :16])
    torch.testing.assert_close(shots["half"][:, 16:], shots["start"][:, 16:])
    assert agrees("sky", scene.with_(sky=lamp))
    torch.testing.assert_close(shots["end"], shots["start"])
    _check_reflection(scene, to_linear(shots["start"]), to_linear(shots["reflection"]))
    on_glass = scene.render(scene.cameras("test"), Subdivision()).normals[0].any(-1)
    left = (to_linear(shots["tint"]) / to_linear(shots["start"]))[on_glass].mean(0)
    assert left[0] > left[1] > left[2]
    assert left[0] < 0.9
    torch.testing.assert_close(shots["tint"][~on_glass], shots["start"][~on_glass])
    assert (found["camera"], found["photograph"], found["alt"], found["unnamed"]) == (1, True, "photograph test_001", 0)


def _check_reflection(scene: TrainedScene, without: torch.Tensor, with_it: torch.Tensor) -> None:
    """On a ball: (1 - F) of the light that came before, and F of the sky that the first surface mirrors."""
    rays = scene.cameras("test").image_rays(0)
    along = (rays.origins * rays.directions).sum(-1)
    squared = along**2 - (rays.origins.square().sum(-1) - RADIUS**2)
    t = -along - squared.clamp(min=0).sqrt()
    normal = torch.nn.functional.normalize(rays.origins + t[:, None] * rays.directions, dim=-1)
    cosine = -(normal * rays.directions).sum(-1)
    after = (1 - (1 - cosine**2) / IOR**2).sqrt()
    s, p = (cosine - IOR * after) / (cosine + IOR * after), (IOR * cosine - after) / (IOR * cosine + after)
    share = (0.5 * (s**2 + p**2))[:, None]
    mirrored = sky_of(rays.directions + 2 * cosine[:, None] * normal)
    expected = (1 - share) * without.view(-1, 3) + share * mirrored
    # Not on the rim, where neighbouring pixels differ by all of F.
    inner = (squared > 0) & (cosine > 0.2)
    assert inner.sum() > 100
    torch.testing.assert_close(with_it.view(-1, 3)[inner], expected[inner], atol=0.01, rtol=0)
    assert share[inner].max() > 0.1


@needs_chromium
def test_fragment_shows_one_camera_alone(scene: TrainedScene, tmp_path: Path) -> None:
    (tmp_path / "scene.html").write_text(make_page(scene, 32), encoding="utf-8")
    address = (tmp_path / "scene.html").as_uri() + "#camera=test_001&size=48"
    with Browser(address, tmp_path, size=(500, 300)) as browser:
        screenshot = base64.b64decode(browser.call("Page.captureScreenshot")["data"])
    with Image.open(io.BytesIO(screenshot)) as image:
        seen = torch.from_numpy(np.array(image.convert("RGB")) / 255.0).float()
    expected = one_ray(scene, scene.cameras("test").select([1]).resized(48, 48))[0]
    assert float(psnr(seen[:48, :48], expected)) > 30
    assert (seen[48:] == seen[-1, -1]).all()
    assert (seen[:48, 48:] == seen[-1, -1]).all()


@needs_chromium
def test_missing_webgl2_is_reported(scene: TrainedScene, tmp_path: Path) -> None:
    with Browser(make_page(scene, 8), tmp_path, "--disable-3d-apis") as browser:
        assert "This page needs WebGL2" in browser.evaluate("$('message').textContent")
        assert browser.evaluate("$('poster').checkVisibility() && $('poster').naturalWidth") == 64


def test_page_loads_nothing_and_names_its_cameras(scene: TrainedScene) -> None:
    page = make_page(scene, 8)
    assert 'src="http' not in page
    assert "import " not in page.partition("<script>")[2]
    assert page.count('"name": "test_') == 3


@pytest.mark.parametrize(("branches", "begins"), [("none", "false"), ("all", "true")])
def test_page_starts_with_the_branches_of_the_model(scene: TrainedScene, branches: str, begins: str) -> None:
    scene = replace(scene, renderer=variant(scene.renderer, path_sampler=Snell(branches=branches)))
    assert f'"reflection": {begins}' in make_page(scene, 8)


def test_page_of_a_medium_without_surface_is_refused(scene: TrainedScene) -> None:
    lens = replace(scene, renderer=with_changed_scene(scene.renderer, medium=Luneburg()))
    refused("bodies with a surface", make_page, lens, 8)


def gl_face(direction: np.ndarray) -> tuple[int, float, float]:
    """Face and texture coordinates of a direction, by OpenGL ES 3.0, table 3.21, written out."""
    x, y, z = direction
    axis = int(np.abs(direction).argmax())
    positive = direction[axis] > 0
    if axis == 0:
        face, s, t, m = (0, -z, -y, x) if positive else (1, z, -y, -x)
    elif axis == 1:
        face, s, t, m = (2, x, z, y) if positive else (3, x, -z, -y)
    else:
        face, s, t, m = (4, x, -y, z) if positive else (5, -x, -y, -z)
    return face, (s / m + 1) / 2, (t / m + 1) / 2


def test_cube_map_directions_match_opengl() -> None:
    size = 5
    for number, direction in enumerate(cube_directions(size).double().numpy()):
        # The shader's way from a direction to the place in the cube: equal angles.
        warped = np.arctan(direction / np.abs(direction).max()) * 4 / np.pi
        face, s, t = gl_face(warped)
        expected = number // size**2, (number % size + 0.5) / size, (number // size % size + 0.5) / size
        assert (face, s, t) == pytest.approx(expected, abs=1e-6)


def test_baked_sky_matches_the_background() -> None:
    background = EnvironmentMap([2, 8])
    torch.nn.init.normal_(background.texels, std=3, generator=torch.Generator().manual_seed(0))
    baked = bake_sky(background, torch.device("cpu"))
    upper, rest = (baked.voxels[name].astype(int) for name in ("sky", "sky_exponent"))
    found = (upper * 2 + (rest >> [0, 1, 2] & 1)) * 2.0 ** ((rest >> 3) - 24)
    radiance = background(Exits(cube_directions(8))).detach().view(6, 8, 8, 3).numpy()
    assert (np.abs(found - radiance) <= radiance.max(-1, keepdims=True) / 500).all()


def unpacked(uri: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The slices of a picture, one by one, as the page's `unpackVoxels` finds them."""
    depth, height, width = shape
    columns = math.ceil(math.sqrt(depth))
    mosaic = np.array(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))))
    return np.stack(
        [
            mosaic[z // columns * height : (z // columns + 1) * height, z % columns * width : (z % columns + 1) * width]
            for z in range(depth)
        ]
    )


@pytest.mark.parametrize("shape", [(1, 2, 3, 1), (5, 4, 3, 2), (6, 8, 8, 3)])
def test_pack_keeps_every_byte(shape: tuple[int, ...]) -> None:
    voxels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    found = unpacked(pack(voxels), shape[:3])
    np.testing.assert_array_equal(found[..., : shape[3]], voxels)
    assert not found[..., shape[3] :].any()


def test_shared_exponent_has_nine_bits_of_precision() -> None:
    radiance = np.random.default_rng(0).lognormal(0, 3, (1000, 3))
    radiance = np.concatenate([radiance, [[0, 0, 0], [1, 1, 1], [0.99999, 0.5, 0], [1e-9, 0, 0], [65408, 1, 0]]])
    upper, rest = shared_exponent(radiance)
    # OpenGL ES 3.0, section 3.8.3.2: mantissa 2^(exponent - 15 - 9).
    mantissa = upper.astype(int) * 2 + (rest.astype(int) >> [0, 1, 2] & 1)
    found = mantissa * 2.0 ** ((rest.astype(int) >> 3) - 24)
    brightest = radiance.max(-1, keepdims=True)
    assert (np.abs(found - radiance) <= np.maximum(brightest / 512, 2.0**-25) * (1 + 1e-9)).all()
