"""Maps per pixel, and the loss on depth against its closed form."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from nerfro.core.cameras import Cameras
from nerfro.data.base import Views
from nerfro.data.image_files import read_depths
from nerfro.geometry.space import Unbounded
from nerfro.losses import terms
from nerfro.losses.terms import Depth
from nerfro.testing import (
    example_batch,
    example_components,
    example_path,
    example_rendering,
    example_run,
    example_views,
)
from nerfro.training.pixel_batches import PixelBatches
from tests.conftest import refused


def test_gradient_is_the_relative_distance_of_each_sample() -> None:
    """d loss / d w_i = min(|m_i - D| / D, limit) / Q, and limit / Q for the final transmittance."""
    rendering, batch, limit = example_rendering(), example_batch(), 0.3
    depth = torch.linspace(2, 6, 24)[:, None]
    depth[:4] = 0  # unknown
    scene = example_run().renderer.scene
    value = Depth(limit, refracted=True)([rendering], replace(batch, maps={"depth": depth}), scene)
    of_weights, of_transmittance = torch.autograd.grad(value, [rendering.weights, rendering.transmittance])
    edges = rendering.samples.edges.detach()
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    expected = ((middles - depth).abs() / depth).clamp(max=limit) / 20
    torch.testing.assert_close(of_weights[4:], expected[4:])
    torch.testing.assert_close(of_transmittance[4:], torch.full((20,), limit / 20))
    assert not of_weights[:4].any()
    assert not of_transmittance[:4].any()


def test_loss_of_two_processes_is_that_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients are averaged, and the parts of the batch have different numbers of known depths."""
    rendering, scene = example_rendering(example_path(8)), example_run().renderer.scene
    counts = 8, 6
    depths = [4.0 * (torch.arange(8) < count)[:, None] for count in counts]
    batches = [replace(example_batch(8), maps={"depth": depth}) for depth in depths]

    def losses() -> torch.Tensor:
        return torch.stack([Depth(refracted=True)([rendering], batch, scene) for batch in batches])

    expected = (losses() * torch.tensor(counts)).sum() / sum(counts)
    monkeypatch.setattr(terms, "rank_and_size", lambda: (0, 2))
    monkeypatch.setattr(terms, "sum_over_processes", lambda count: torch.tensor(sum(counts)))
    torch.testing.assert_close(losses().mean(), expected)


def test_refracted_pixels_do_not_count_by_default() -> None:
    rendering, batch = example_rendering(), example_batch()
    scene = example_run().renderer.scene
    (of_weights,) = torch.autograd.grad(Depth()([rendering], batch, scene), [rendering.weights])
    refracted = example_path().refracted
    assert 0 < refracted.sum() < len(refracted)
    assert not of_weights[refracted].any()
    assert of_weights[~refracted].any(-1).all()


def test_steps_of_descent_move_the_end_of_a_ray_to_its_depth() -> None:
    """Densities on a straight ray, learned from the depth alone."""
    path = example_path()[~example_path().refracted]
    batch = example_batch(len(path.ray))
    logits = torch.zeros(len(path.ray), 16, requires_grad=True)
    optimizer = torch.optim.Adam([logits], 0.3)
    template, scene = example_rendering(path), example_run().renderer.scene
    middles = 0.5 * (template.samples.edges[:, 1:] + template.samples.edges[:, :-1])
    for _ in range(200):
        shares = torch.cat([logits, torch.zeros(len(logits), 1)], -1).softmax(-1)
        rendering = replace(template, weights=shares[:, :-1], transmittance=shares[:, -1])
        optimizer.zero_grad()
        Depth()([rendering], batch, scene).backward()
        optimizer.step()
    spacing = middles.diff(dim=1).max()
    assert ((rendering.weights * middles).sum(-1) - batch.maps["depth"][:, 0]).abs().max() < spacing
    assert rendering.transmittance.max() < 0.01


def test_depths_along_the_axis_become_arc_lengths(tmp_path) -> None:
    """Of a plane across the axis: the depth is constant, and a point at the arc length lies on the plane."""
    cameras: Cameras = example_views().cameras
    Image.fromarray(np.full((32, 32), 2500, np.uint16)).save(tmp_path / "a.png")
    holes = np.full((16, 16), 2.5)
    holes[3, 5] = np.nan
    np.save(tmp_path / "b.npy", holes)
    depths = read_depths([tmp_path / "a.png", None], 0.001, cameras)
    rays = cameras.image_rays(0)
    points = rays.origins + depths[0].view(-1, 1) * rays.directions
    torch.testing.assert_close(points[:, 2], torch.full((256,), 1.5))  # the camera is at z = 4 and looks along -z
    assert not depths[1].any()
    other = read_depths([None, tmp_path / "b.npy"], 1.0, cameras)[1]
    torch.testing.assert_close(other[0], depths[0][0])
    assert other[3, 5] == 0
    np.save(tmp_path / "c.npy", np.zeros((4, 4, 3)))
    refused("write one number for each pixel", read_depths, [tmp_path / "c.npy"], 1.0, cameras.select([0]))


def test_maps_arrive_in_batches_by_pixel_and_follow_a_selection() -> None:
    views = example_views()
    number = torch.arange(2 * 16 * 16, dtype=torch.float32).view(2, 16, 16, 1)
    views = replace(views, maps={"number": number, "two": number.expand(-1, -1, -1, 2)})
    pixels = PixelBatches(views, 32).draw(0)
    torch.testing.assert_close(pixels.maps["number"][:, 0].long(), pixels.number)
    assert pixels.maps["two"].shape == (32, 2)
    assert torch.equal(views.select([1]).maps["number"], number[1:])
    # Without the constructor, whose annotations are checked in tests alone.
    wrong = SimpleNamespace(**vars(views) | {"maps": {"x": number[:, :8]}})
    refused(r"Views\.maps\['x'\] has the shape \[2, 8, 16, 1\]", Views.__post_init__, wrong)


def test_data_without_depths_are_refused_before_training() -> None:
    with pytest.raises(Exception, match="loss=depth needs depths"):
        Depth.derive(OmegaConf.create({}), example_views(), Unbounded())
    views = replace(example_views(), maps={"depth": torch.ones(2, 16, 16, 1)})
    assert Depth.derive(OmegaConf.create({}), views, example_components().space) == {}
