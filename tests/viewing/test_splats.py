"""Gaussians are projected as the formulas say, fitted to straight rays, and read by other programs."""

import gzip
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

import nerfro
from nerfro.exports import splats
from nerfro.exports.gaussians import Gaussians
from nerfro.exports.splats import fitted_gaussians
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.geometry.mesh import load_mesh
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.exports import ExportConfig
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Runner, refused
from tests.viewing.conftest import RADIUS
from tests.viewing.test_exports import document_of, validated, with_box, write

OPTIONS = ExportConfig(checkpoint="run", what="splats", out="a.spz")
SMALL = {"gaussians": 400, "steps": 3, "resolution": 16}


def random_gaussians(number: int = 50) -> Gaussians:
    """Gaussians near the origin, of all opacities."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(number, 3), normal(number, 3) - 3, normal(number, 4), normal(number), normal(number, 4, 3) / 4
    )


def test_one_gaussian_has_the_projected_covariance_and_colour(scene: TrainedScene) -> None:
    camera = replace(scene.cameras("train").select([2]), fy=torch.tensor([33.0]), cx=torch.tensor([18.0]))
    position, deviations = torch.tensor([0.3, -0.2, 0.4]), torch.tensor([0.5, 0.2, 0.1])
    turn = Rotation.from_euler("xyz", [0.3, 1.1, -0.4])
    quaternion = torch.from_numpy(2 * turn.as_quat()[[3, 0, 1, 2]]).float()
    harmonics = torch.tensor([[0.5, 0.1, -0.6], [0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, -0.2]])
    one = Gaussians(position[None], deviations.log()[None], quaternion[None], torch.tensor([0.4]), harmonics[None])
    jacobian = torch.autograd.functional.jacobian(lambda p: camera.project(p[None])[0][0, 0], position)
    axes = torch.from_numpy(turn.as_matrix()).float() * deviations
    covariance = jacobian @ axes @ axes.T @ jacobian.T + 0.3 * torch.eye(2)
    rows, columns = torch.meshgrid(torch.arange(32) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    offsets = torch.stack([columns, rows], -1) - camera.project(position[None])[0][0, 0]
    alpha = torch.tensor(0.4).sigmoid() * torch.exp(
        -0.5 * torch.einsum("hwi,ij,hwj->hw", offsets, torch.linalg.inv(covariance), offsets)
    )
    x, y, z = torch.nn.functional.normalize(position - camera.camera_to_world[0, :, 3], dim=0)
    basis = torch.stack([torch.tensor(0.5 / math.sqrt(math.pi)), *(math.sqrt(0.75 / math.pi) * v for v in (-y, z, -x))])
    expected = torch.where(alpha < 1 / 255, 0.0, alpha)[..., None] * (0.5 + basis @ harmonics)
    assert expected.max() > 0.2
    torch.testing.assert_close(one.render(camera, 0), expected, atol=1e-5, rtol=1e-4)


def test_content_near_a_camera_is_seen_before_any_sky(scene: TrainedScene) -> None:
    camera = replace(scene.cameras("train").select([0]), near=0.05, far=float("inf"))
    forward = -camera.camera_to_world[0, :, 2]
    near, sky = (camera.camera_to_world[0, :, 3] + distance * forward for distance in (0.1, 1e4))
    number = torch.tensor([0, *[1] * 9])
    all_of_them = Gaussians(
        torch.stack([near, sky])[number], torch.tensor([[-3.0], [6.0]])[number].expand(-1, 3), torch.ones(10, 4),
        torch.full((10,), 9.0), torch.zeros(10, 4, 3),
    )  # fmt: skip
    all_of_them.harmonics[0, 0, 0] = 1.0
    alone = Gaussians(*(values[:1] for values in all_of_them)).render(camera, 0)
    assert alone[8, 8, 0] > 0.6
    torch.testing.assert_close(all_of_them.render(camera, 0)[8, 8, 0], alone[8, 8, 0], atol=0.02, rtol=0)


def test_spz_of_large_units_is_refused_before_the_fit(
    scene: TrainedScene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(splats, "_SPZ_DISTANCE", 0.1)
    refused(r"units from the object, and \.spz .* take \.ply", splats.write_splats, scene, tmp_path / "a.spz", OPTIONS)


def test_triangles_of_files_without_glass_are_refused(scene: TrainedScene, tmp_path: Path) -> None:
    options = replace(OPTIONS, triangles=500)
    refused(r"triangles=500 has no effect on \.ply; remove it", splats.write_splats, scene, tmp_path / "a.ply", options)


def test_ply_is_read_with_the_names_of_the_common_layout(tmp_path: Path) -> None:
    gaussians = random_gaussians()
    (tmp_path / "g.ply").write_bytes(gaussians.to_ply())
    loaded = trimesh.load(tmp_path / "g.ply")
    data = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(loaded.vertices, gaussians.positions, atol=1e-6)
    np.testing.assert_allclose(data["opacity"], gaussians.logits)
    for i in range(3):
        np.testing.assert_allclose(data[f"f_dc_{i}"], gaussians.harmonics[:, 0, i])
        np.testing.assert_allclose(data[f"scale_{i}"], gaussians.log_scales[:, i])
        for n in range(3):
            np.testing.assert_allclose(data[f"f_rest_{3 * i + n}"], gaussians.harmonics[:, 1 + n, i])
    quaternions = np.stack([data[f"rot_{i}"] for i in range(4)], -1)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    assert (np.einsum("ni,ni->n", quaternions, gaussians.rotations) > 0).all()


def test_spz_holds_the_gaussians_in_few_bits() -> None:
    gaussians = random_gaussians()
    content, number = gzip.decompress(gaussians.to_spz()), len(gaussians.positions)
    assert content[:16] == b"NGSP\x02\0\0\0" + number.to_bytes(4, "little") + bytes([1, content[13], 0, 0])
    columns = np.split(np.frombuffer(content[16:], np.uint8), number * np.cumsum([9, 1, 3, 3, 3]))
    padded = np.pad(columns[0].reshape(-1, 3), ((0, 0), (1, 0))).reshape(-1).view("<i4") >> 8
    np.testing.assert_allclose(padded.reshape(-1, 3) / 2 ** content[13], gaussians.positions, atol=2.0 ** -content[13])
    alphas, colours, scales, rotations, rest = (column.astype(float).reshape(number, -1) for column in columns[1:])
    np.testing.assert_allclose(alphas[:, 0] / 255, gaussians.logits.sigmoid(), atol=0.002)
    np.testing.assert_allclose((colours / 255 - 0.5) / 0.15, gaussians.harmonics[:, 0], atol=0.014)
    np.testing.assert_allclose(scales / 16 - 10, gaussians.log_scales, atol=0.032)
    vectors = rotations / 127.5 - 1
    scalars = np.sqrt(np.maximum(1 - (vectors**2).sum(1), 0))
    turns = Rotation.from_quat(np.column_stack([vectors, scalars]))
    expected = Rotation.from_quat(gaussians.rotations[:, [1, 2, 3, 0]].numpy())
    assert (turns.inv() * expected).magnitude().max() < 0.15
    clipped = gaussians.harmonics[:, 1:].flatten(1).clamp(-1, 1)
    np.testing.assert_allclose((rest - 128) / 128, clipped, atol=0.04)


@pytest.mark.slow
def test_splats_show_what_straight_rays_see(scene: TrainedScene) -> None:
    options = ExportConfig("-", "splats", "-", gaussians=4000, steps=300)
    gaussians, psnr = fitted_gaussians(scene, options)
    cameras = scene.cameras("train")
    expected = scene.with_(glass=False).render(cameras, Subdivision()).rgb
    images = torch.stack([gaussians.render(cameras, view) for view in range(3)])
    assert -10 * torch.log10((images - expected).square().mean()) > 30
    assert psnr > 30


def test_glb_has_gaussians_beside_the_glass(scene: TrainedScene, tmp_path: Path) -> None:
    described = write(scene, "splats", tmp_path / "ball.glb", **SMALL)
    assert described.startswith("440 Gaussians, ")
    document = document_of(tmp_path / "ball.glb")
    assert "KHR_gaussian_splatting" in document["extensionsUsed"]
    nodes = {node["name"]: node for node in document["nodes"]}
    assert {"glass_0", "gaussians"} <= set(nodes)
    (primitive,) = document["meshes"][nodes["gaussians"]["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    counts = {name: document["accessors"][number]["count"] for name, number in primitive["attributes"].items()}
    assert set(counts.values()) == {440}
    names = {name.removeprefix("KHR_gaussian_splatting:") for name in counts}
    assert {"SCALE", "ROTATION", "OPACITY", "SH_DEGREE_0_COEF_0", "SH_DEGREE_1_COEF_2"} <= names
    matrix = np.array(nodes["gaussians"]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3], Z_UP_TO_Y_UP)
    # Gaussians are no part of the body when nerfro reads the file.
    again = load_mesh(tmp_path / "ball.glb", accept_open_mesh=True).vertices
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), RADIUS, atol=3e-3)
    # The validator does not know the extension, whose names of attributes have a colon.
    messages = validated(tmp_path / "ball.glb")["issues"]["messages"]
    assert [entry for entry in messages if "KHR_gaussian_splatting" not in json.dumps(entry)] == []


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_scenes_without_glass_become_splats(scene: TrainedScene, suffix: str, tmp_path: Path) -> None:
    write(with_box(scene.with_(glass=False)), "splats", tmp_path / f"straight{suffix}", **SMALL)
    assert (tmp_path / f"straight{suffix}").stat().st_size > 440 * 12


@pytest.mark.slow
def test_trained_runs_are_exported_by_command_and_function(trained_run: Path, command: Runner, tmp_path: Path) -> None:
    options = [f"{name}={value}" for name, value in SMALL.items()]
    out = tmp_path / "command.ply"
    assert "440 Gaussians" in command("export", f"checkpoint={trained_run}", "what=splats", f"out={out}", *options)
    nerfro.export(trained_run, "splats", tmp_path / "function.ply", **SMALL)
    assert (tmp_path / "function.ply").read_bytes() == out.read_bytes()
