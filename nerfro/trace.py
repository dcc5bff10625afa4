"""`python -m nerfro.trace medium.mesh=M.ply medium.ior=1.5 rays=R.npz out=O.npz`: trace rays through a medium.

Examples:
    nerfro trace medium.mesh=glass.ply medium.ior=1.5 rays=rays.npz out=exits.npz
    nerfro trace medium.mesh=glass.ply medium.ior=1.5 sampler/path=eikonal rays=rays.npz out=exits.npz
"""

from __future__ import annotations

import rich
import torch
from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.evaluation.path_plot import draw_paths
from nerfro.files.atomic import refuse_existing
from nerfro.files.cache import save_arrays
from nerfro.registry.registration import build
from nerfro.rendering.scene_file import with_scene
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from nerfro.samplers.paths.traced_file import TraceConfig, leave_box, make_rays, read_rays


@entry_point("trace", TraceConfig, expand=with_scene)
def main(config: DictConfig) -> None:
    """Read rays, trace the rays, and write exit positions and directions."""
    out = user_path(config.out)
    if out.suffix != ".npz":
        raise NerfroError(f"out={out} is not allowed; the output is a NumPy archive and must end in .npz")
    refuse_existing([out, out.with_suffix(".png")] if config.plot else [out], config.overwrite)
    origins, directions = read_rays(user_path(config.rays))
    sampler = build(config.sampler.path)
    medium = build(config.medium)
    warn_of_thin_walls(sampler, medium)
    rays = make_rays(origins, directions, medium, config.near, config.far)
    trace = sampler.trace(rays, medium)
    path, num_exceeded = trace.path, int(trace.exceeded.sum())
    positions, lengths = (path.end_positions, path.far) if config.far is not None else leave_box(path, medium.box)
    arrays = {
        "exit_positions": positions + torch.from_numpy(medium.origin),
        "exit_directions": path.exit_directions,
        "path_lengths": lengths,
        "hit": path.refracted,
    }
    if path.splits:
        arrays |= {"ray": path.ray, "throughput": path.throughput}
    save_arrays(out, {name: tensor.numpy() for name, tensor in arrays.items()})
    split = f" on {len(path.ray)} paths" if path.splits else ""
    rich.print(
        f"{len(rays)} rays traced{split}, {int(path.main_polyline(path.refracted).sum())} met the object; wrote {out}"
    )
    if num_exceeded:
        rich.print(f"{num_exceeded} paths reached the limit of {sampler.max_events} events and continue straight")
    if config.plot:
        shown = torch.linspace(0, len(rays) - 1, min(len(rays), 24)).round().long()
        draw_paths(path.select_rays(shown), medium, out.with_suffix(".png"))
        rich.print(f"drew {len(shown)} rays in {out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
