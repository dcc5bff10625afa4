"""Small rays, paths, samples, renderings and runs, which tests of plugins pass to a component."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path as FilePath
from typing import Literal

import torch

from nerfro.backgrounds.base import ConstantBackground
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.cameras import Cameras
from nerfro.core.compositing import composite
from nerfro.core.draws import Draws
from nerfro.core.types import Batch, FieldValues, Path, Rays, Rendering, Samples
from nerfro.data.base import DataSource, Views
from nerfro.fields.hash_grid import HashGridField
from nerfro.geometry.space import Box, Contracted
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.material import Material
from nerfro.media.surfaces import BallSurface
from nerfro.models.refractive import RefractiveModel
from nerfro.rendering import Components, RayTracer
from nerfro.samplers.base import Straight
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.points.stratified import Stratified, point_samples
from nerfro.training.phases.base import TrainingRun
from nerfro.training.pixel_batches import PixelBatches

NUM_RAYS = 24


def example_space() -> Box:
    """Return a cube of side 2 around the origin."""
    return Box([[-1.0] * 3, [1.0] * 3])


def example_contracted_space() -> Contracted:
    """Return all of space, contracted outside the ball of radius 1 around the origin."""
    return Contracted([[-1.0] * 3, [1.0] * 3], radius=1.0)


def example_rays(num_rays: int = NUM_RAYS) -> Rays:
    """Return rays from around the unit cube towards the cube; many meet a ball of radius 0.8."""
    generator = torch.Generator().manual_seed(7)
    origins = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=generator), dim=-1) * 4
    targets = torch.randn(num_rays, 3, generator=generator) * 0.6
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    like = torch.ones(num_rays)
    return Rays(origins, directions, 1e-3 * like, 2 * like, 6 * like)


def example_ball() -> Bodies:
    """Return a glass ball of radius 0.8 on a coarse grid."""
    ball = Body("ball", BallSurface(0.8), Material(1.5))
    return Bodies([ball], grid=GridSettings(resolution=32))


def example_path(num_rays: int = NUM_RAYS, branches: Literal["none", "all"] = "none") -> Path:
    """Return paths through a glass ball; with `branches="all"`, rays split at its surface."""
    return Snell(branches=branches)(example_rays(num_rays), example_ball())


def example_samples(path: Path | None = None) -> Samples:
    """Return sixteen samples on each polyline of a path, by default of the example path."""
    path = example_path() if path is None else path
    fractions = torch.linspace(0.0, 0.95, 16)
    return point_samples(path, path.near[:, None] + fractions * (path.far - path.near)[:, None])


def example_rendering(path: Path | None = None, scale: float = 1.0) -> Rendering:
    """Render samples with a smooth density; densities and colours require gradients.

    Args:
        path: rendered path, by default the example path.
        scale: factor of the density.
    """
    path = example_path() if path is None else path
    samples = example_samples(path)
    density = (scale * torch.exp(-samples.positions.square().sum(-1))).requires_grad_()
    radiance = torch.sigmoid(samples.positions).requires_grad_()
    return composite(samples, FieldValues(density, radiance), torch.full((len(path.ray), 3), 0.3), path)


def example_views() -> Views:
    """Return two grey photographs of 16 x 16 pixels."""
    pose = torch.eye(4)[:3].repeat(2, 1, 1)
    pose[:, 2, 3] = 4
    two = torch.full((2,), 8.0)
    cameras = Cameras(pose, two, two, two, two, width=16, height=16, near=2.0, far=6.0)
    return Views(cameras, torch.full((2, 16, 16, 3), 0.5), None, ["first", "second"])


def example_batch(num_rays: int = NUM_RAYS, rays_per_pixel: int = 1) -> Batch:
    """Return a batch of the example rays through grey pixels, with the cameras of the example views."""
    pixel = torch.arange(num_rays) // rays_per_pixel
    every = pixel.unique()
    return Batch(
        rays=example_rays(num_rays),
        ray_pixel=pixel,
        pixel_number=every,
        view=every % 2,
        rgb=torch.full((len(every), 3), 0.5),
        teaches_background=torch.ones(len(every), dtype=torch.bool),
        cameras=example_views().cameras,
        draws=example_draws(num_rays),
        maps={"depth": torch.full((len(every), 1), 4.0)},
    )


def example_run(initial_depth: float = 1.0) -> TrainingRun:
    """Return a small model with a learned background, its batches and its optimizer; equal in every call.

    Args:
        initial_depth: optical depth of the content.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = RefractiveModel(replace(example_components(initial_depth), background=EnvironmentMap([8])))
    batches = PixelBatches(example_views(), NUM_RAYS, "all_images")
    optimizer = torch.optim.Adam(model.parameters_by_name().values())
    return TrainingRun(model, batches, RayTracer(model), example_views(), optimizer, spent=0.0)


def example_draws(num_rays: int = NUM_RAYS, step: int = 0) -> Draws:
    """Return random numbers of a training step."""
    return Draws(seed=0, step=step, ray=torch.arange(num_rays))


def example_components(initial_depth: float = 1.0) -> Components:
    """Return the components of a small model with straight rays, a black background and uniform content."""
    return Components(
        medium=example_ball(),
        path_sampler=Straight(),
        point_sampler=Stratified(8),
        make_field=lambda: HashGridField(
            example_space(),
            num_levels=2,
            log2_table_size=8,
            width=16,
            initial_depth=initial_depth,
            precision="float32",
        ),
        background=ConstantBackground(),
        space=example_space(),
    )


class ExampleData(DataSource):
    """The example views as a data set."""

    root = FilePath()
    splits = ["train", "test"]  # noqa: RUF012 - a constant

    def load(self, split: str) -> Views:
        return example_views()


class LuneburgLens(Medium):
    """Luneburg lens of radius 1: n^2 = 2 - r^2, which focuses parallel rays on the opposite point of its surface."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.tensor([[-1.0] * 3, [1.0] * 3]), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        squared = 2 - positions.square().sum(-1)
        n = squared.clamp(min=1).sqrt()
        return n, torch.where((squared > 1)[..., None], -positions / n[..., None], 0.0)
