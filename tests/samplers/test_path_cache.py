"""Cached paths are the traced ones, and never those of anything else."""

from __future__ import annotations

import dataclasses
import io
import sys
from pathlib import Path

import pytest
import torch

from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.media.sdf_grid import SdfGrid
from nerfro.pixel_parts import PixelParts
from nerfro.samplers import path_cache
from nerfro.samplers.eikonal import Eikonal
from nerfro.samplers.path_cache import PathCache
from nerfro.samplers.snell import Snell
from nerfro.types import Rays

SIDE = 24


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))


def _cameras(distance: float = 4.0) -> Cameras:
    poses = torch.zeros(3, 3, 4)
    for view, axis in enumerate(([0, 0, 1.0], [1.0, 0, 0], [0, 0.6, 0.8])):
        z = torch.tensor(axis)
        x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.1]), z), dim=0)
        poses[view] = torch.stack([x, torch.linalg.cross(z, x), z, distance * z], -1)
    focal, centre = torch.full((3,), 1.2 * SIDE), torch.full((3,), SIDE / 2)
    return Cameras(poses, focal, focal, centre, centre, SIDE, SIDE, 2.0, 6.0)


def _medium(radius: float = 0.8, ior: float = 1.5) -> SdfGrid:
    axis = torch.linspace(-1.5, 1.5, 40)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    return SdfGrid.from_distances(points.norm(dim=-1)[None] - radius, box, [ior], 0.01)


def _batch(cameras: Cameras, jitter: bool = False) -> tuple[torch.Tensor, Rays]:
    index = torch.randint(0, 3 * SIDE * SIDE, (500,))
    shift = torch.rand(500, 2) if jitter else None
    view, row, column = index // SIDE**2, index // SIDE % SIDE, index % SIDE
    return index, cameras.rays(view, row, column, shift)


@pytest.mark.parametrize("sampler", [Snell(), Eikonal()], ids=["snell", "eikonal"])
@pytest.mark.parametrize("memory_limit", [2.0, 0.0], ids=["memory", "disk"])
def test_cached_paths_are_the_traced_ones(sampler: Snell | Eikonal, memory_limit: float) -> None:
    cameras, medium = _cameras(), _medium()
    cache = PathCache.build(sampler, medium, PixelParts(cameras), memory_limit)
    index, rays = _batch(cameras)
    cached, traced = cache(index, rays), sampler(rays, medium)
    assert 0.1 < float(traced.refracted.float().mean()) < 0.9
    s = torch.linspace(2.0, 6.0, 200).expand(500, -1)
    for a, b in zip(cached.at(s), traced.at(s), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)
    for name in ("exit_directions", "refracted", "near", "far", "exit_positions"):
        torch.testing.assert_close(getattr(cached, name), getattr(traced, name), rtol=0, atol=1e-6)


def test_straight_rays_are_not_stored() -> None:
    cache = PathCache.build(Snell(), _medium(), PixelParts(_cameras()))
    bent = cache.starts.diff() > 0
    assert len(cache.vertices) == 4 * int(bent.sum())
    nothing = PathCache.build(Snell(), _medium(), PixelParts(_cameras(-40.0)))
    assert nothing.vertices.shape == (0, 7)
    index, rays = _batch(_cameras(-40.0))
    assert not nothing(index, rays).refracted.any()


def test_the_second_build_reads_what_the_first_wrote(tmp_path: Path) -> None:
    class Counting(Snell):
        calls = 0

        def forward(self, rays, medium):
            Counting.calls += 1
            return super().forward(rays, medium)

    first = PathCache.build(Counting(), _medium(), PixelParts(_cameras()))
    calls = Counting.calls
    second = PathCache.build(Counting(), _medium(), PixelParts(_cameras()))
    assert Counting.calls == calls > 0
    torch.testing.assert_close(first.vertices, second.vertices, rtol=0, atol=0)


def test_any_change_is_another_entry(tmp_path: Path) -> None:
    cameras, medium = _cameras(), _medium()
    moved = dataclasses.replace(cameras, camera_to_world=cameras.camera_to_world + 1e-5)
    variants = [
        (Snell(), medium, cameras),
        (Snell(max_events=3), medium, cameras),
        (Eikonal(), medium, cameras),
        (Snell(), _medium(ior=1.5001), cameras),
        (Snell(), _medium(radius=0.8001), cameras),
        (Snell(), medium, moved),
        (Snell(), medium, dataclasses.replace(cameras, far=6.5)),
    ]
    for sampler, body, views in variants:
        PathCache.build(sampler, body, PixelParts(views))
    assert len(list((tmp_path / "cache").glob("paths_*.f32"))) == len(variants)


def test_jittered_rays_are_refused() -> None:
    cameras = _cameras()
    cache = PathCache.build(Snell(), _medium(), PixelParts(cameras))
    index, rays = _batch(cameras, jitter=True)
    with pytest.raises(NerfroError, match="jitter"):
        cache(index, rays)


def test_a_truncated_file_is_not_used(tmp_path: Path) -> None:
    PathCache.build(Snell(), _medium(), PixelParts(_cameras()))
    file = next((tmp_path / "cache").glob("paths_*.f32"))
    file.write_bytes(file.read_bytes()[:-28])
    with pytest.raises(NerfroError, match="truncated"):
        PathCache.build(Snell(), _medium(), PixelParts(_cameras()))
    PathCache.build(Snell(), _medium(), PixelParts(_cameras()))


class _Console(io.StringIO):
    """Text that says whether it is a terminal."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.mark.parametrize(
    ("terminal", "silent_seconds", "shown"), [(True, 0.0, True), (True, 60.0, False), (False, 0.0, False)]
)
def test_long_tracing_shows_its_progress_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, terminal: bool, silent_seconds: float, shown: bool
) -> None:
    console = _Console(terminal)
    monkeypatch.setattr(path_cache, "_SILENT_SECONDS", silent_seconds)
    monkeypatch.setattr(sys, "stderr", console)
    PathCache.build(Snell(), _medium(), PixelParts(_cameras()))
    PathCache.build(Snell(), _medium(), PixelParts(_cameras()))  # read from disk: nothing to show
    text = console.getvalue()
    assert ("trace: 100%" in text and "ray/s" in text) == shown
    assert shown or not text
    assert text.count("\n") == (1 if shown else 0)
