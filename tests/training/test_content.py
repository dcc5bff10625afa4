"""The space that a run covers, and the resolution of its background."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import DictConfig, OmegaConf

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.space import Contracted, Unbounded
from nerfro.media.base import Vacuum
from nerfro.registry.allowed import untyped
from nerfro.testing import example_views
from nerfro.training.config import TrainConfig, build_medium
from nerfro.training.content import common_target, content_settings, describe, space_of
from nerfro.training.derivation import derived
from nerfro.training.settings import with_values
from tests.conftest import composed
from tests.exact_silhouettes import cameras_around

MIDDLE = np.array([0.4, -2.0, 1.0])


def around(num: int) -> Cameras:
    """Cameras that look at one place from a distance of 3, with 40 pixels of focal length."""
    cameras = cameras_around(num, 16, distance=3.0, focal=2.5)
    cameras.camera_to_world[..., 3] += torch.from_numpy(MIDDLE)
    return cameras


def of_all_space(**content: object) -> DictConfig:
    config = OmegaConf.structured(untyped(TrainConfig(medium={})))
    config = with_values(config, {"content.space": "all", **{f"content.{name}": content[name] for name in content}})
    return with_values(config, content_settings(config, Vacuum(), around(7))).content


def finest_cells(radius: float) -> int:
    views, space = replace(example_views(), cameras=around(7)), Contracted(np.stack([MIDDLE - 1, MIDDLE + 1]), radius)
    return HashGridField.derive(OmegaConf.create(), views, space)["finest_resolution"]


def test_content_ball_lies_at_the_target_of_the_cameras() -> None:
    content = of_all_space()
    np.testing.assert_allclose(np.mean([content.box_min, content.box_max], axis=0), MIDDLE, atol=1e-4)
    assert content.radius == 1.5
    assert content.near == pytest.approx(0.9)
    assert "contracted beyond 1.5 around (0.4, -2, 1)" in describe(OmegaConf.create({"content": content, "field": {}}))


def test_finest_cells_are_half_a_pixel_wide() -> None:
    # A pixel is 3 / 40 wide there, and contracted space 6; two cells a pixel.
    assert finest_cells(1.5) == pytest.approx(160, abs=1)
    assert finest_cells(6.0) == pytest.approx(640, abs=1)
    assert finest_cells(0.75) == 128  # 80 would be too few


def test_explicit_settings_are_kept() -> None:
    explicit = {"box_min": [0.0, 0.0, 0.0], "box_max": [2.0, 2.0, 2.0], "radius": 5.0, "near": 0.0}
    content = of_all_space(**explicit)
    assert {name: content[name] for name in explicit} == explicit


def test_parallel_cameras_have_a_default_depth() -> None:
    centres = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    forward = np.tile([0.0, 0.0, -1.0], (4, 1))
    np.testing.assert_allclose(common_target(centres, forward, 4.0), [0.5, 0.5, -4.0], atol=1e-9)


@pytest.mark.parametrize("space", ["box", "unbounded"])
def test_content_without_contraction_needs_no_cameras(space: str) -> None:
    box = {"content.box_min": [0.0] * 3, "content.box_max": [1.0] * 3}
    config = with_values(OmegaConf.structured(untyped(TrainConfig(field={}))), {"content.space": space, **box})
    assert content_settings(config, Vacuum(), around(0)) == box
    assert space_of(config.content).has_box == (space == "box")
    assert describe(config) == ""


@pytest.mark.parametrize(
    ("side", "fits", "given", "descent", "finest"),
    [
        (64, True, None, 128, 128),
        (128, True, None, 256, 256),
        (256, True, None, 256, 512),
        (256, False, None, 512, 512),
        (4000, True, None, 256, 1024),
        (4000, False, None, 512, 512),
        (256, True, [4, 32], 32, 32),
    ],
)
def test_finest_texel_follows_the_pixel(
    side: int, fits: bool, given: list[int] | None, descent: int, finest: int
) -> None:
    views = replace(example_views(), cameras=cameras_around(3, side, focal=1.4))
    config = OmegaConf.create({
        "background": {"resolutions": given, "fitted_resolutions": None},
        "phase": {"background": {"steps": 10 if fits else 0}},
    })  # fmt: skip
    settings = {**config.background} | EnvironmentMap.derive(config, views, Unbounded())
    resolutions, fitted = settings["resolutions"], settings["fitted_resolutions"]
    config.background.fitted_resolutions = [512]
    assert EnvironmentMap.derive(config, views, Unbounded()) == {}, "given levels are kept"
    assert max(resolutions) == descent
    assert max([*resolutions, *(fitted or ())]) == finest
    if given is None and side < 4000 and fits:
        pixel = 57.3 / (1.4 * side)
        assert 2**-0.5 < (90 / finest) / pixel < 2**0.5


@pytest.mark.parametrize(
    ("medium", "interface"),
    [
        (["medium.mesh={cube}", "medium.ior=1.5"], "mesh"),
        (["medium.mesh={cube}", "medium.ior=1.5", "sampler.path.interface=sdf"], "sdf"),
        (["medium.mesh={hole}", "medium.ior=1.5", "medium.accept_open_mesh=true"], "sdf"),
        (["medium.bodies={{ball: {{surface: {{name: ball, radius: 1}}, ior: 1.5}}}}"], "sdf"),  # has no triangles
        (["medium.bodies={{one: {{mesh: {cube}, ior: 1.5}}, other: {{mesh: {cube}, ior: 1.3}}}}"], "mesh"),
        (
            [
                "medium.accept_open_mesh=true",
                "medium.bodies={{one: {{mesh: {cube}, ior: 1.5}}, other: {{mesh: {hole}, ior: 1.3}}}}",
            ],
            "sdf",
        ),
        (["+experiment=straight"], None),
    ],
)
def test_training_traces_the_triangles_of_closed_meshes(
    medium: list[str], interface: str | None, tmp_path: Path
) -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    files = {"cube": box, "hole": trimesh.Trimesh(box.vertices, box.faces[1:])}
    for name, mesh in files.items():
        mesh.export(tmp_path / f"{name}.ply")
    config = composed(*[option.format(**{name: tmp_path / f"{name}.ply" for name in files}) for option in medium])
    assert derived(config, build_medium(config), example_views()).sampler.path.get("interface") == interface
