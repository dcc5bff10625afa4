"""Export of surroundings and content as 3-D Gaussians, which straight rays see."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_srgb
from nerfro.core.progress import track
from nerfro.exports.gaussians import HARMONIC_0, Gaussians
from nerfro.exports.gltf import DEFAULT_TRIANGLES, encode_glb
from nerfro.exports.meshes import glass_meshes
from nerfro.files.atomic import write_atomically
from nerfro.geometry.normals import fibonacci_lattice
from nerfro.registry.allowed import refuse_unused
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene

_SKY_DISTANCE = 100.0  # of Gaussians of the background, in distances of the farthest camera from the object
_SPZ_DISTANCE = 100.0  # of cameras, world units
_MAX_PIXELS, _MAX_VIEWS = 256, 128  # longest side and number of pictures that Gaussians are fitted to
_RATES = {"positions": 0.1, "log_scales": 0.02, "rotations": 0.02, "logits": 0.05, "harmonics": 0.01}  # of Adam


def write_splats(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write Gaussians as .ply or .spz, or as .glb (KHR_gaussian_splatting) beside the glass meshes."""
    suffix = out.suffix.lower()
    if suffix != ".glb":
        refuse_unused(options, ["triangles"], f"on {suffix}")
    if suffix == ".spz":
        _require_moderate_units(scene)
    gaussians, psnr = fitted_gaussians(scene, options)
    if suffix == ".glb":
        content = encode_glb(scene, glass_meshes(scene, options.triangles or DEFAULT_TRIANGLES), None, gaussians)
    else:
        content = gaussians.to_ply() if suffix == ".ply" else gaussians.to_spz()
    write_atomically(out, content)
    return f"{len(gaussians.positions)} Gaussians, {psnr:.1f} dB against straight rays of the training cameras"


def _require_moderate_units(scene: TrainedScene) -> None:
    """Refuse scenes whose distant Gaussians are larger than an .spz file can hold, exp(5.94) units."""
    farthest = float((scene.cameras("train").camera_to_world[:, :, 3].cpu() - scene.bounds.mean(0)).norm(dim=-1).max())
    if farthest > _SPZ_DISTANCE:
        raise NerfroError(
            f"a camera is {farthest:.0f} units from the object, and .spz holds scenes of up to {_SPZ_DISTANCE:.0f}; "
            "take .ply or .glb"
        )


def fitted_gaussians(scene: TrainedScene, options: ExportConfig) -> tuple[Gaussians, float]:
    """Make Gaussians of a scene without its glass, and fit them to its images in the training cameras.

    Returns:
        The Gaussians, and the PSNR of the last images of the fit.
    """
    cameras = scene.cameras("train")
    cameras.refuse_turntable("Gaussians stand still in the room", "take what=mesh")
    straight = scene.with_(glass=False)
    views = np.linspace(0, len(cameras) - 1, min(len(cameras), _MAX_VIEWS)).round().astype(int).tolist()
    longest = max(cameras.width, cameras.height)
    scale = (options.resolution or min(_MAX_PIXELS, longest)) / longest
    width, height = (max(1, round(scale * side)) for side in (cameras.width, cameras.height))
    cameras = replace(cameras.select(views), distortion=None).resized(width, height)
    images = straight.render(cameras, Subdivision(), progress=True).rgb
    initial = _drawn(straight, cameras, images, scene.bounds.mean(0), options.gaussians)
    return _fitted(initial, cameras.to("cpu"), images, options.steps)


def _drawn(
    scene: TrainedScene, cameras: Cameras, images: Float[Tensor, "V H W 3"], centre: Float[Tensor, "3"], number: int
) -> Gaussians:
    """Draw points along the rays of random pixels with the probability that their light comes from there.

    Points of the background, and a tenth as many points for directions that no camera sees, lie on a distant sphere.
    """
    generator, renderer = torch.Generator().manual_seed(0), scene.renderer
    pixels = torch.randint(images[..., 0].numel(), (number,), generator=generator)
    thresholds = torch.rand(number, 1, generator=generator).to(cameras.device)
    view, row, column = torch.unravel_index(pixels.to(cameras.device), images.shape[:3])
    rays = cameras.rays(view, row, column)

    def lengths(rows: slice) -> Float[Tensor, " rows"]:
        rendering = renderer(rays[rows])[-1]
        sample = torch.searchsorted(rendering.weights.cumsum(-1), thresholds[rows])
        return functional.pad(rendering.samples.s, (0, 1), value=math.inf).gather(1, sample)[:, 0]

    length = torch.cat(renderer.map_chunks(lengths, thresholds, renderer.chunk_size)).cpu()
    origins, directions = rays.origins.cpu(), rays.directions.cpu()
    distance = _SKY_DISTANCE * float((origins - centre).norm(dim=-1).max())
    of_sky = centre + distance * directions
    positions = torch.where(length[:, None] < distance, origins + length.nan_to_num()[:, None] * directions, of_sky)
    elsewhere = torch.from_numpy(fibonacci_lattice(number // 10)).float()
    # Behind the sky that cameras see.
    positions = torch.cat([positions, centre + 1.1 * distance * elsewhere])
    colours = torch.cat([images.view(-1, 3)[pixels], to_srgb(scene.background(elsewhere)).clamp(0, 1)])
    distances, _ = scipy.spatial.KDTree(positions.numpy()).query(positions.numpy(), 4)
    spacing = torch.from_numpy(distances[:, 1:].mean(1)).float()
    harmonics = functional.pad((colours - 0.5)[:, None] / HARMONIC_0, (0, 0, 0, 3))
    rotations = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(positions), 4)
    log_scales = (0.5 * spacing).clamp(min=1e-7 * distance).log()[:, None].expand(-1, 3)
    return Gaussians(positions, log_scales, rotations, torch.ones(len(positions)), harmonics)


def _fitted(
    initial: Gaussians, cameras: Cameras, images: Float[Tensor, "V H W 3"], steps: int
) -> tuple[Gaussians, float]:
    """Minimize the squared error of images by Adam, one image for each step; positions move in units of the size."""
    size, generator = initial.log_scales[:, :1].exp(), torch.Generator().manual_seed(0)
    offsets = initial._replace(positions=torch.zeros_like(initial.positions))
    learned = {name: value.clone().requires_grad_() for name, value in offsets._asdict().items()}
    groups = [{"params": [value], "lr": _RATES[name]} for name, value in learned.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / max(steps, 1)))

    def gaussians() -> Gaussians:
        return Gaussians(**learned)._replace(positions=initial.positions + size * learned["positions"])

    errors: list[float] = []
    views: list[int] = []
    for _ in track("fit splats", range(steps)):
        views = views or torch.randperm(len(images), generator=generator).tolist()
        view = views.pop()
        error = (gaussians().render(cameras, view) - images[view]).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        schedule.step()
        errors.append(float(error.detach()))
    last = errors[-len(images) :]
    return Gaussians(*(value.detach() for value in gaussians())), -10 * math.log10(sum(last) / max(len(last), 1))


EXPORTS["splats"] = Export(
    (".ply", ".spz", ".glb"), write_splats, uses=("resolution", "triangles", "gaussians", "steps", "sky")
)
