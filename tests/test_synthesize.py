"""`nerfro.synthesize`: written, kept and refused files, and the embedded scene."""

import json
import shlex

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import max_pool2d

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.light import to_linear, to_srgb
from nerfro.core.paths import ASSETS_DIR
from nerfro.core.types import Exits
from nerfro.data.formats.transforms import BlenderData
from nerfro.files import lat_long
from nerfro.geometry.mesh import load_mesh
from nerfro.registry.allowed import validate
from nerfro.synthetic.dataset import ViewSplits
from nerfro.synthetic.options import SynthesizeConfig
from nerfro.synthetic.scene import SurfaceMesh, SyntheticScene
from nerfro.synthetic.scenes.photographs import Photographs
from nerfro.synthetic.synthesis import synthesize
from tests.conftest import refused
from tests.exact_silhouettes import overlaps_of_convex_body

EMBEDDED = ASSETS_DIR / "torus"
SPLITS = {"train": 100, "val": 10, "test": 20}


def configured(**options):
    """The configuration of the command line, with other values."""
    return validate(SynthesizeConfig, options)


def small(folder, **options):
    views = {"train": 2, "val": 1, "test": 1}
    return configured(
        **{"out": str(folder), "resolution": 12, "spp": 2, "test_spp": 3, "views": views, "sky_height": 16, **options}
    )


def frames(folder, split):
    transforms = json.loads((folder / f"transforms_{split}.json").read_text())
    return transforms["camera_angle_x"], transforms["frames"]


def test_embedded_scene_is_complete_and_small():
    total = sum(path.stat().st_size for path in EMBEDDED.rglob("*") if path.is_file())
    assert total < 4e6
    for split, count in SPLITS.items():
        _, views = frames(EMBEDDED, split)
        assert len(views) == count
        for frame in views:
            assert Image.open(EMBEDDED / f"{frame['file_path']}.png").size == (128, 128)
            assert Image.open(EMBEDDED / frame["mask_path"]).mode == "L"


@pytest.mark.parametrize("data", [ViewSplits, Photographs])
def test_printed_command_quotes_the_folder(data, tmp_path):
    folder, empty = tmp_path / "torus [1]", SurfaceMesh(*[np.empty((0, 3))] * 3)
    scene = SyntheticScene(ior=1.5, glass=empty, interior=empty, sky=None)
    words = shlex.split(data(configured(), scene, folder).next_command())
    assert {f'data.root="{folder}"', f'out="{folder}"'} & set(words)


def test_masks_match_the_projected_mesh():
    vertices = load_mesh(EMBEDDED / "mesh.ply").vertices
    for split in SPLITS:
        assert min(overlaps_of_convex_body(BlenderData(str(EMBEDDED)).load(split), vertices)) > 0.995


def test_sky_image_matches_the_sky_in_the_images():
    views = BlenderData(str(EMBEDDED)).load("test")
    sky = EnvironmentMap([256], image=str(EMBEDDED / "sky.png"))
    for view in range(3):
        seen = to_srgb(sky(Exits(views.cameras.image_rays(view).directions))).view(128, 128, 3)
        near = max_pool2d(views.masks[view][None], 3, 1, 1)[0] > 0
        error = (views.images[view] - seen).abs()[~near]
        assert error.median() < 0.01  # texels against averaged pixels: edges differ, areas do not


@pytest.mark.usefixtures("mitsuba")
def test_interrupted_rendering_is_resumed(tmp_path):
    folder = synthesize(small(tmp_path / "scene")).folder
    pictures = sorted(folder.rglob("r_*.png"))
    assert len(pictures) == 2 * 4
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in pictures}
    lost = folder / "train" / "r_001.png"
    lost.unlink()
    (folder / "transforms_test.json").unlink()
    synthesize(small(folder))
    assert lost.read_bytes() == before[lost][0]
    again = {path for path in pictures if path.stat().st_mtime_ns != before[path][1]}
    assert again <= {lost, folder / "masks" / "train" / "r_001.png"}
    assert (folder / "transforms_test.json").is_file()
    assert not list(folder.rglob("*.partial"))


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
def test_existing_data_set_is_replaced_only_on_request_and_other_files_are_kept(tmp_path):
    folder = synthesize(small(tmp_path / "scene")).folder
    (folder / "notes.txt").write_text("mine")
    assert (folder / "interior.ply").is_file()
    before = (folder / "train" / "r_000.png").read_bytes()
    refused("overwrite=true", synthesize, small(folder, seed=1))
    assert (folder / "train" / "r_000.png").read_bytes() == before
    synthesize(small(folder, seed=1, views={"train": 1, "val": 1, "test": 1}, extras=False, overwrite=True))
    assert not (folder / "interior.ply").exists()
    assert (folder / "train" / "r_000.png").read_bytes() != before
    assert not (folder / "train" / "r_001.png").exists()
    assert (folder / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(("name", "content"), [("thesis.tex", "chapter 1"), ("meta.json", "{}"), ("meta.json", "[")])
@pytest.mark.usefixtures("mitsuba")
def test_folder_with_other_content_is_not_changed(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    refused("it is no data set of nerfro", synthesize, small(tmp_path, overwrite=True))
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, content)]


def test_linear_images_have_the_radiance_that_8_bits_clip(mitsuba, tmp_path):
    lat_long.save_lat_long(tmp_path / "sky.exr", torch.full((16, 32, 3), 3.0))
    options = {"scene": "torus", "sky": str(tmp_path / "sky.exr"), "resolution": 8}
    for form in ("png", "exr"):
        synthesize(small(tmp_path / form, format=form, **options))
    linear, clipped = (BlenderData(str(tmp_path / form)).load("train") for form in ("exr", "png"))
    assert to_linear(linear.images[0])[0, 0].tolist() == pytest.approx([3.0] * 3, rel=1e-3)
    torch.testing.assert_close(linear.images[:].clamp(0, 1), clipped.images[:], rtol=0, atol=0.51 / 255)
    for options, message in (
        ({"scene": "dolphin_capture", "format": "exr"}, "scene=dolphin_capture has no option format"),
        ({"scene": "dolphin_capture", "cameras": "ring"}, "has no option cameras"),
        ({"cameras": "file"}, "cameras=file takes the cameras of a glTF file"),
    ):
        refused(message, synthesize, small(tmp_path / "d", **options))
