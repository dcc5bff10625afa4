"""Paths of all training rays, traced once."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path as FilePath

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from tqdm import tqdm

import nerfro
from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.files.cache import cache_dir, content_hash, load_arrays, save_arrays
from nerfro.geometry.mesh import TriangleMesh
from nerfro.kernels.threads import use_threads
from nerfro.media.base import Medium
from nerfro.pixel_parts import PixelParts
from nerfro.samplers.base import PathSampler
from nerfro.types import Path, Rays

# Position, direction and arc length of a vertex.
_COLUMNS = 7
_BYTES_PER_VERTEX = 4 * _COLUMNS
_RAYS_AT_ONCE = 8192
# Shorter work shows no progress bar.
_SILENT_SECONDS = 2.0
# Largest difference of a component that rounding makes.
_SAME_DIRECTION = 1e-5


class PathCache:
    """The bent paths through pixels, or parts of pixels, of a set of cameras, one row of vertices after another.

    Poses and medium do not change in training, so neither do the paths. Rays that miss the medium are not stored: they
    are straight. A bent path takes 28 bytes a vertex and usually four to ten vertices.

    Attributes:
        starts: where each ray's vertices begin, and the end.
        vertices: position, direction and arc length; in memory, or mapped from disk.
    """

    def __init__(self, starts: Int[Tensor, "R+1"], vertices: Float[Tensor, "U 7"]) -> None:
        self.starts = starts
        self.vertices = vertices

    @classmethod
    def build(
        cls, path_sampler: PathSampler, medium: Medium, parts: PixelParts, memory_limit: float = 2.0
    ) -> PathCache:
        """Trace rays, or load their paths when the same was traced before.

        The file's name is a hash of rays, medium, sampler and nerfro's version, so paths of anything else are never
        found. The trace itself needs the memory of one chunk of rays.

        Args:
            path_sampler, medium: how rays bend.
            parts: the rays.
            memory_limit: gigabytes of vertices that are kept in memory; more are mapped from disk.

        Raises:
            NerfroError: the cache folder cannot be written.
        """
        key = content_hash(nerfro.__version__, *_describe(path_sampler), *_describe(medium), *_describe_rays(parts))
        index_file, vertex_file = cache_dir() / f"paths_{key}.npz", cache_dir() / f"paths_{key}.f32"
        if not (index_file.is_file() and vertex_file.is_file()):
            _trace_to_disk(path_sampler, medium, parts, index_file, vertex_file)
        starts = load_arrays(index_file)["starts"]
        if vertex_file.stat().st_size != starts[-1] * _BYTES_PER_VERTEX:
            index_file.unlink()
            raise NerfroError(f"{vertex_file} is truncated; it was taken out of the cache, start again")
        shape = (int(starts[-1]), _COLUMNS)
        vertices: np.ndarray
        if starts[-1] == 0:
            vertices = np.zeros(shape, np.float32)
        elif vertex_file.stat().st_size <= memory_limit * 1e9:
            vertices = np.fromfile(vertex_file, np.float32).reshape(shape)
        else:
            # Copy-on-write, because tensors cannot be read-only; nothing is ever written.
            vertices = np.memmap(vertex_file, np.float32, "c", shape=shape)
        return cls(torch.from_numpy(starts), torch.from_numpy(vertices))

    def __call__(self, index: Int[Tensor, "R"], rays: Rays) -> Path:
        """Paths of some of the rays.

        Args:
            index: number of each ray in the `PixelParts`.
            rays: the same rays; those that are not stored go straight.

        Raises:
            NerfroError: a stored path does not begin at its ray, as when rays are jittered within their pixels.
        """
        from nerfro.kernels.stored_paths import gather_paths  # compiled code, so only where it is used

        use_threads()
        rows, starts = index.cpu().numpy(), self.starts.numpy()
        counts = starts[rows + 1] - starts[rows]
        path = np.empty((len(rows), max(int(counts.max(initial=2)), 2), _COLUMNS), np.float32)
        own = (rays.origins, rays.directions, rays.near, rays.far)
        origins, directions, near, far = (tensor.cpu().float().contiguous().numpy() for tensor in own)
        vertices = self.vertices.numpy()
        if gather_paths(starts, vertices, rows, origins, directions, near, far, _SAME_DIRECTION, path) > 0:
            raise NerfroError(
                "cached paths are of other rays; they hold for rays through fixed places, so switch jitter off"
            )
        all_vertices = torch.from_numpy(path).to(rays.origins.device)
        positions, along, s = all_vertices[..., :3], all_vertices[..., 3:6], all_vertices[..., 6]
        refracted = torch.from_numpy(counts > 0).to(s.device)
        return Path(positions, along, s, along[:, -1], refracted, rays.radii)


def _trace_to_disk(
    path_sampler: PathSampler, medium: Medium, parts: PixelParts, index_file: FilePath, vertex_file: FilePath
) -> None:
    counts = []
    temporary = ""
    progress = tqdm(
        total=len(parts),
        unit="ray",
        unit_scale=True,
        desc="trace",
        dynamic_ncols=True,
        delay=_SILENT_SECONDS,
        disable=None,
    )
    try:
        index_file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=vertex_file.parent, suffix=".tmp", delete=False) as file, progress:
            temporary = file.name
            for start in range(0, len(parts), _RAYS_AT_ONCE):
                stop = min(start + _RAYS_AT_ONCE, len(parts))
                path = path_sampler(parts.rays(torch.arange(start, stop, device=parts.cameras.device)), medium)
                ends = (path.s[:, 1:] > path.s[:, :-1]).long()
                # Rows end where s stops growing; what follows repeats the last vertex.
                lengths = torch.where(path.refracted, path.s.shape[1] - ends.flip(1).cumsum(1).eq(0).sum(1), 0)
                used = torch.arange(path.s.shape[1], device=path.s.device) < lengths[:, None]
                rows = torch.cat([path.positions, path.directions, path.s[..., None]], -1)[used]
                rows.float().cpu().numpy().tofile(file)
                counts.append(lengths.cpu())
                progress.update(stop - start)
        os.replace(temporary, vertex_file)
    except OSError as error:
        if temporary:
            FilePath(temporary).unlink(missing_ok=True)
        raise NerfroError(
            f"cannot keep paths in {vertex_file.parent}: {error.strerror}; free space or set NERFRO_CACHE elsewhere"
        ) from error
    starts = torch.cat([torch.zeros(1, dtype=torch.long), torch.cat(counts).cumsum(0)])
    save_arrays(index_file, {"starts": starts.numpy()})


def _describe(part: nn.Module) -> list[np.ndarray | str]:
    """All that a medium or sampler computes with: its class, plain settings, tensors and meshes."""
    description: list[np.ndarray | str] = [f"{type(part).__module__}.{type(part).__qualname__}"]
    for name, value in sorted(vars(part).items()):
        if isinstance(value, (bool, int, float, str, tuple)) and name != "training":
            description.append(f"{name}={value!r}")
        elif isinstance(value, list):
            for mesh in value:
                if isinstance(mesh, TriangleMesh):
                    description += [mesh.vertices, mesh.faces]
    for name, tensor in sorted([*part.named_buffers(), *part.named_parameters()]):
        description += [name, tensor.detach().cpu().numpy()]
    return description


def _describe_rays(parts: PixelParts) -> list[np.ndarray | str]:
    pixels = [] if parts.pixels is None else [parts.pixels.cpu().numpy()]
    return [*_describe_cameras(parts.cameras), f"{parts.side}", *pixels]


def _describe_cameras(cameras: Cameras) -> list[np.ndarray | str]:
    tensors = [cameras.camera_to_world, cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    tensors += [] if cameras.distortion is None else [cameras.distortion]
    numbers = (cameras.width, cameras.height, cameras.near, cameras.far)
    return [*(tensor.cpu().numpy() for tensor in tensors), repr(numbers)]
