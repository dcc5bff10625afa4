"""Alignment of camera rotations by the panorama of a distant sky.

The radiance of the sky in each direction is the mean of the photographs that show this direction, and is therefore
eliminated. The unknowns are three rotation parameters per camera, and each Gauss-Newton step solves for all cameras. If
the sky were trained together with the cameras, each camera would stay where the sky has reproduced its photograph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn import functional as F

from nerfro.cameras import Cameras
from nerfro.light import to_linear
from nerfro.progress import track
from nerfro.rays import Rays
from nerfro.subdivision import pixel_rays

from .least_squares import PriorInformation, axes_across, robust_weights
from .refined import RefinedCamera

# Photographs are downscaled to this width in pixels; the alignment is accurate to a few hundredths of a pixel.
_WIDTH = 256
# Per step: standard deviation of the blur relative to the width, and number of directions per photograph.
_STEPS = ((1 / 32, 150),) * 4 + ((1 / 64, 150),) * 3 + ((1 / 128, 200),) * 3 + ((0.0, 300),) * 3
_MIN_BLUR = 0.7  # pixels
# Minimum fraction of sky in a blurred pixel, and scale of the robust error.
_MIN_SKY, _SCALE = 0.9, 0.1
# Damping relative to the diagonal, which keeps cameras fixed that share no direction with others.
_DAMPING = 1e-2
# Minimum variance of colours: the square of half an 8-bit level.
_MIN_VARIANCE = (0.5 / 255) ** 2
_TINY = 1e-9


@torch.no_grad()
def align(
    camera: RefinedCamera,
    cameras: Cameras,
    photographed: Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
) -> PriorInformation | None:
    """Rotate the cameras, and adapt the common lens if it is refined, until photographs of the sky agree.

    Args:
        camera: estimated cameras, changed in place.
        cameras: cameras of the data set.
        photographed: colours of pixels in the photographs, sRGB in [0, 1].
        of_sky: whether rays reach the sky without meeting the object.

    Returns:
        Prior information about rotations and lens, except for a common rotation of all cameras. None if no two
        photographs show the same part of the sky.
    """
    images = _downscaled_roots(cameras, photographed)
    gains, generator = images.new_ones(len(cameras), 3), torch.Generator().manual_seed(0)
    information = None
    for relative_blur, num in track("panorama", _STEPS):
        blur = max(relative_blur * images.shape[-1], _MIN_BLUR)
        overlap = _overlap(camera, cameras, images, of_sky, blur, num, generator)
        if overlap is None:
            continue  # if little sky is visible, strongly blurred pixels always contain other objects
        matrix, vector, variance = _equations(overlap, gains, learn_gains=camera.exposure is not None)
        num_turns, num_lens = 3 * len(cameras), overlap.lens.shape[-1]
        step = _solve(matrix, vector).to(images)
        turns, lens, log_gains = step.split([num_turns, num_lens, len(step) - num_turns - num_lens])
        gains = gains * log_gains.exp().view(-1, 3) if len(log_gains) else gains
        turns, max_pixels = turns.view(-1, 3), 2 * blur * cameras.width / images.shape[-1]
        turns = turns * (max_pixels / turns.norm(dim=-1, keepdim=True).clamp(min=_TINY)).clamp(max=1)
        camera.move(F.pad(turns, (0, 3)), lens)
        information = _marginalized(matrix, num_turns + num_lens) / max(variance, _MIN_VARIANCE)
    if information is None:
        return None
    # The photographs do not determine a common rotation of all cameras.
    common = camera.motions.common_rotations().to(information)
    projection = torch.eye(len(information)).to(information)
    projection[: len(common), : len(common)] -= common @ common.mT
    numbers = camera.numbers()
    motions, lens = camera.split(torch.arange(len(numbers), device=information.device))
    index = torch.cat([motions[:, :3].flatten(), lens])
    known = information.new_zeros(len(numbers), len(numbers))
    known[index[:, None], index] = projection @ information @ projection
    return PriorInformation(numbers, known.to(numbers))


def _solve(
    matrix: Float[Tensor, "parameters parameters"], right: Float[Tensor, " parameters *columns"]
) -> Float[Tensor, " parameters *columns"]:
    """Return the damped Gauss-Newton step for a normal matrix and a gradient."""
    return -torch.linalg.solve(matrix + torch.diag(_DAMPING * matrix.diagonal() + _TINY), right)


def _marginalized(matrix: Float[Tensor, "parameters parameters"], num: int) -> Float[Tensor, "M M"]:
    """Return the information about the first `num` parameters, with the others eliminated (Schur complement)."""
    own, mixed = matrix[:num, :num], matrix[num:, :num]
    return own + mixed.mT @ _solve(matrix[num:, num:], mixed) if len(mixed) else own


def _downscaled_roots(cameras: Cameras, photographed: Callable[[Tensor], Tensor]) -> Float[Tensor, "V 3 h w"]:
    """Return square roots of linear radiance, at most `_WIDTH` wide, in which exposures are factors as well."""
    height, width = cameras.height, cameras.width
    factor = min(1.0, _WIDTH / width)
    size = max(1, round(factor * height)), max(1, round(factor * width))
    pixels = torch.arange(height * width, device=cameras.device)
    images = []
    for view in range(len(cameras)):
        image = photographed(view * height * width + pixels).view(1, height, width, 3).permute(0, 3, 1, 2)
        images.append(F.interpolate(to_linear(image.float()), size, mode="area").sqrt())
    return torch.cat(images)


def _blurred(images: Float[Tensor, "V C h w"], deviation: float) -> Float[Tensor, "V C h w"]:
    """Convolve images with a Gaussian; pixels outside the images are black."""
    deviations = 0, 0, deviation, deviation
    blurred = gaussian_filter(images.cpu().numpy(), deviations, mode="constant", radius=int(3 * deviation) + 1)
    return torch.from_numpy(blurred).to(images)


@dataclass(frozen=True)
class _Overlap:
    """O observations of K directions by V cameras; each direction is observed at least twice.

    Attributes:
        num_views: number of cameras.
        view: index of the camera of each observation.
        direction: index of the direction of each observation.
        colour: blurred colours.
        turns: derivatives of the colours by the rotation of the camera.
        lens: derivatives of the colours by the lens.
    """

    num_views: int
    view: Int[Tensor, "O"]
    direction: Int[Tensor, "O"]
    colour: Float[Tensor, "O 3"]
    turns: Float[Tensor, "O 3 3"]
    lens: Float[Tensor, "O 3 L"]


def _overlap(
    camera: RefinedCamera,
    cameras: Cameras,
    images: Float[Tensor, "V 3 h w"],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
    blur: float,
    num: int,
    generator: torch.Generator,
) -> _Overlap | None:
    """Draw directions of the sky in each photograph, and find their colours in all photographs that show these."""
    (height, width), num_views = images.shape[-2:], len(images)
    small = camera.estimated(cameras).resized(width, height)
    sky = torch.stack([of_sky(small.image_rays(view)) for view in range(num_views)]).view(num_views, 1, height, width)
    fraction = _blurred(sky.to(images), blur)
    images = _blurred(images * sky, blur) / fraction.clamp(min=_TINY)
    usable = sky & (fraction > _MIN_SKY)
    # The same number of pixels is drawn from each view, if the view has enough.
    order = torch.rand(num_views, height * width, generator=generator).to(images) + ~usable.flatten(1)
    drawn = order.argsort(1)[:, :num]
    views = torch.arange(num_views, device=drawn.device)[:, None]
    pixels = (views * height * width + drawn)[usable.flatten(1).gather(1, drawn)]
    directions = pixel_rays(small, pixels).directions
    far = replace(small, camera_to_world=F.pad(small.camera_to_world[..., :3], (0, 1)))
    position, depth = far.project(directions)
    column, row = position.floor().long().unbind(-1)
    visible = (depth > 0) & (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    visible &= usable[views, 0, row, column]
    visible &= visible.sum(0) > 1
    view, direction = visible.nonzero(as_tuple=True)
    if len(view) == 0:
        return None

    def sampled(directions: Float[Tensor, "directions 3"]) -> Float[Tensor, "O 3"]:
        return _sample(images, view, far.project(directions)[0][visible])

    angle = 1 / small.fx.mean()
    by_direction = images.new_zeros(len(view), 3, 3)
    for axis in axes_across(directions):
        ends = [sampled(directions + side * angle * axis) for side in (0.5, -0.5)]
        by_direction += ((ends[0] - ends[1]) / angle)[..., None] * axis[direction, None]
    # A rotation of the camera moves the image in the opposite direction, hence the negative sign.
    position = position[visible] * position.new_tensor([cameras.width / width, cameras.height / height])
    pixel = position.floor()
    rays = cameras.rays(view, pixel[:, 1], pixel[:, 0], position - pixel)
    slopes = -camera.slopes(rays, view, torch.zeros_like(by_direction), by_direction)
    return _Overlap(num_views, view, direction, sampled(directions), slopes[..., :3], slopes[..., 6:])


def _sample(
    images: Float[Tensor, "V 3 h w"], view: Int[Tensor, "O"], position: Float[Tensor, "O 2"]
) -> Float[Tensor, "O 3"]:
    """Interpolate colours linearly at positions (column, row); pixel corners are at whole numbers."""
    (height, width), centre = images.shape[-2:], view[:, None] + 0.5
    size = position.new_tensor([width, height, len(images)])
    grid = 2 * torch.cat([position, centre], 1) / size - 1  # the views are the third axis of the grid
    volume = images.transpose(0, 1)[None]
    return F.grid_sample(volume, grid[None, None, None], padding_mode="border", align_corners=False)[0, :, 0, 0].T


def _equations(
    overlap: _Overlap, gains: Float[Tensor, "V 3"], learn_gains: bool
) -> tuple[Float[Tensor, "parameters parameters"], Float[Tensor, " parameters"], float]:
    """Compute matrix and gradient of the normal equations with the sky eliminated, and the variance of the colours.

    The parameters are three rotations per view, the lens, and, with `learn_gains`, three logarithmic gains per view.
    """
    view, direction, num = overlap.view, overlap.direction, len(overlap.view)
    colour, weight, num_directions = overlap.colour * gains[view], gains.new_ones(num), int(direction.max()) + 1
    for _ in range(2):
        total = weight.new_zeros(num_directions).index_add(0, direction, weight).clamp(min=_TINY)
        mean = colour.new_zeros(num_directions, 3).index_add(0, direction, weight[:, None] * colour) / total[:, None]
        error = colour - mean[direction]
        weight = robust_weights(error, _SCALE)
    total = weight.new_zeros(num_directions).index_add(0, direction, weight).clamp(min=_TINY)

    of_view, num_lens = torch.arange(3, device=view.device) + 3 * view[:, None], overlap.lens.shape[-1]
    of_lens = 3 * overlap.num_views + torch.arange(num_lens, device=view.device)
    slopes, indices = [torch.cat([overlap.turns, overlap.lens], -1) * gains[view][..., None]], [of_view]
    indices.append(of_lens.expand(num, -1))
    if learn_gains:
        slopes.append(torch.diag_embed(colour))
        indices.append(3 * overlap.num_views + num_lens + of_view)
    values, columns = torch.cat(slopes, -1).double().cpu(), torch.cat(indices, -1).cpu()
    rows = torch.arange(3 * num).view(num, 3, 1).expand(values.shape)
    columns = columns[:, None].expand(values.shape)
    size = 3 * num, 3 * overlap.num_views * (2 if learn_gains else 1) + num_lens
    jacobian = sparse.csr_matrix((values.flatten(), (rows.flatten(), columns.flatten())), size)

    weight, total, direction = (tensor.cpu() for tensor in (weight.double(), total.double(), direction))
    root = np.repeat(weight.sqrt().numpy(), 3)
    share = np.repeat((weight / total[direction].sqrt()).numpy(), 3)
    channels = (3 * direction[:, None] + torch.arange(3)).flatten()
    means = sparse.csr_matrix((share, (channels, np.arange(3 * num))), (3 * num_directions, 3 * num))
    own, common = sparse.diags(root) @ jacobian, means @ jacobian
    matrix = torch.from_numpy((own.T @ own - common.T @ common).toarray())
    residual = error.double().cpu().flatten().numpy()
    variance = float((root * residual) @ (root * residual) / (root @ root))
    return matrix, torch.from_numpy(own.T @ (root * residual)), variance
