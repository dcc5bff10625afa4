"""Plots of paths through a medium."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerfro.core.types import Path
from nerfro.files.atomic import atomic_file
from nerfro.media.base import Medium

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg


def draw_paths(path: Path, medium: Medium, file: FilePath) -> None:
    """Write a plot of a few paths and the medium to a PNG file; see `plot_paths`."""
    with atomic_file(file) as stream:
        _draw(path, medium).print_png(stream)


def image_of_paths(path: Path, medium: Medium) -> UInt8[np.ndarray, "H W 3"]:
    """Render the plot of `draw_paths` as a small image in memory."""
    return np.asarray(_draw(path, medium, dpi=70).buffer_rgba())[..., :3].copy()


def _draw(path: Path, medium: Medium, dpi: int = 150) -> FigureCanvasAgg:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 7), layout="constrained", dpi=dpi)
    canvas = FigureCanvasAgg(figure)
    plot_paths(figure.add_subplot(), path, medium)
    canvas.draw()
    return canvas


def plot_paths(axes: Axes, path: Path, medium: Medium) -> None:
    """Plot paths over the refractive index in the plane that contains most of the paths.

    The plane passes through the centre of the medium's box, and all paths are projected onto it. Branches of split
    light are drawn with an opacity that increases with throughput.
    """
    vertices = path.positions.detach().cpu()
    centre = medium.box.mean(0).to(vertices)
    across, up = _plane(path.main_polyline(vertices), centre)
    # The margin around the box is 15 % of its longest side.
    half = (0.5 + 0.15) * float((medium.box[1] - medium.box[0]).max())
    steps = torch.linspace(-half, half, 600).to(centre)
    points = centre + steps[None, :, None] * across + steps[:, None, None] * up
    n = torch.cat([medium(rows)[0].cpu() for rows in points.to(medium.box).split(50)])
    extent = (-half, half, -half, half)
    axes.imshow(n, cmap="Blues", vmin=1, vmax=2 * float(n.max()) - 1, extent=extent, origin="lower")
    for positions, share in zip(vertices, path.throughput.cpu(), strict=True):
        flat = positions - centre
        # Weak branches remain visible. With dispersion, the branch of each wavelength is drawn in its own colour.
        strength = float(share.max())
        drawn = "tab:red" if float(share.min()) == strength else tuple((share / strength).tolist())
        axes.plot(flat @ across, flat @ up, color=drawn, linewidth=0.8, alpha=0.15 + 0.85 * strength**0.5)
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    axes.set_aspect("equal")
    axes.set_xlabel("world units")


def _plane(
    positions: Float[Tensor, "P S 3"], centre: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return two orthogonal unit vectors: mean direction of the rays, and orthogonal direction of largest spread."""
    along = torch.nn.functional.normalize((positions[:, -1] - positions[:, 0]).mean(0), dim=0)
    offsets = (positions - centre).reshape(-1, 3)
    offsets = offsets - (offsets @ along)[:, None] * along
    _, _, spread = torch.linalg.svd(offsets, full_matrices=False)
    across = spread[0] - (spread[0] @ along) * along
    return along, torch.nn.functional.normalize(across, dim=0)
