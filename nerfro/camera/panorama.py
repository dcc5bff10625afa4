"""Cameras turned until photographs show the same in the same direction: the panorama of a distant sky.

The sky is no unknown: in each direction it is the mean of the photographs that show it. What is left are three numbers
for each camera, and one step of Gauss-Newton solves for all together. A sky that is learned along with the cameras
would hold each of them where it has painted its own photograph.
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

from nerfro.camera.least_squares import Told, axes_across, robust_weights
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.light import to_linear
from nerfro.progress import track
from nerfro.rays import Rays
from nerfro.subdivision import pixel_rays

# Photographs are reduced to this width: places are found to a few hundredths of a pixel.
_WIDTH = 256
# Of each step: the blur of the photographs (standard deviation, of their width), and directions that are taken of each.
_STEPS = ((1 / 32, 150),) * 4 + ((1 / 64, 150),) * 3 + ((1 / 128, 200),) * 3 + ((0.0, 300),) * 3
_LEAST_BLUR = 0.7  # pixels
# A blurred pixel counts if it is of the sky alone, nearly; and an error of so much counts much less.
_OF_SKY, _SCALE = 0.9, 0.1
# Of the normal equations' diagonal, added to it: what no other photograph shows stays.
_DAMPING = 1e-2
# Half a level of 8 bits, squared: photographs agree no better than that.
_LEAST_VARIANCE = (0.5 / 255) ** 2
_TINY = 1e-9


@torch.no_grad()
def align(
    camera: RefinedCamera,
    cameras: Cameras,
    photographed: Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
) -> Told | None:
    """Turn the cameras, and change the lens that they share if it is refined, until photographs of the sky agree.

    Args:
        camera: what is believed of the cameras; it is changed.
        cameras: as the data give them.
        photographed: colours of pixels in the photographs, sRGB in [0, 1].
        of_sky: which rays meet nothing before the sky.

    Returns:
        What is known then, but for a turn of all cameras together; none where no two photographs show the same piece
        of sky.
    """
    pictures = _reduced(cameras, photographed)
    gains, generator = pictures.new_ones(len(cameras), 3), torch.Generator().manual_seed(0)
    information = None
    for share, num in track("panorama", _STEPS):
        blur = max(share * pictures.shape[-1], _LEAST_BLUR)
        overlap = _overlap(camera, cameras, pictures, of_sky, blur, num, generator)
        if overlap is None:
            continue  # where little of the sky is seen, only what is hardly blurred is of it alone
        matrix, vector, variance = _equations(overlap, gains, learn_gains=camera.exposure is not None)
        num_turns, num_lens = 3 * len(cameras), overlap.lens.shape[-1]
        step = _solved(matrix, vector).to(pictures)
        turns, lens, brighter = step.split([num_turns, num_lens, len(step) - num_turns - num_lens])
        gains = gains * brighter.exp().view(-1, 3) if len(brighter) else gains
        turns, longest = turns.view(-1, 3), 2 * blur * cameras.width / pictures.shape[-1]
        turns = turns * (longest / turns.norm(dim=-1, keepdim=True).clamp(min=_TINY)).clamp(max=1)
        camera.move(F.pad(turns, (0, 3)), lens)
        information = _without(matrix, num_turns + num_lens) / max(variance, _LEAST_VARIANCE)
    if information is None:
        return None
    together = camera.motions.together().to(information)
    others = torch.eye(len(information)).to(information)
    others[: len(together), : len(together)] -= together @ together.mT
    numbers = camera.numbers()
    motions, lens = camera.split(torch.arange(len(numbers), device=information.device))
    place = torch.cat([motions[:, :3].flatten(), lens])
    known = information.new_zeros(len(numbers), len(numbers))
    known[place[:, None], place] = others @ information @ others
    return Told(numbers, known.to(numbers))


def _solved(matrix: Float[Tensor, "N N"], right: Float[Tensor, "N *K"]) -> Float[Tensor, "N *K"]:
    """The step along which an error falls that has this matrix of second derivatives and this gradient; damped."""
    return -torch.linalg.solve(matrix + torch.diag(_DAMPING * matrix.diagonal() + _TINY), right)


def _without(matrix: Float[Tensor, "N N"], num: int) -> Float[Tensor, "M M"]:
    """What is told of the first numbers where the others are whatever fits best (Schur's complement)."""
    own, mixed = matrix[:num, :num], matrix[num:, :num]
    return own + mixed.mT @ _solved(matrix[num:, num:], mixed) if len(mixed) else own


def _reduced(cameras: Cameras, photographed: Callable[[Tensor], Tensor]) -> Float[Tensor, "V 3 h w"]:
    """Square roots of the photographs' radiance, no wider than `_WIDTH`: other exposures are factors of them, too."""
    height, width = cameras.height, cameras.width
    factor = min(1.0, _WIDTH / width)
    size = max(1, round(factor * height)), max(1, round(factor * width))
    pixels = torch.arange(height * width, device=cameras.device)
    found = []
    for view in range(len(cameras)):
        picture = photographed(view * height * width + pixels).view(1, height, width, 3).permute(0, 3, 1, 2)
        found.append(F.interpolate(to_linear(picture.float()), size, mode="area").sqrt())
    return torch.cat(found)


def _blurred(pictures: Float[Tensor, "V C h w"], deviation: float) -> Float[Tensor, "V C h w"]:
    """Convolved with a Gaussian; what is beyond the frame is black."""
    deviations = 0, 0, deviation, deviation
    found = gaussian_filter(pictures.cpu().numpy(), deviations, mode="constant", radius=int(3 * deviation) + 1)
    return torch.from_numpy(found).to(pictures)


@dataclass(frozen=True)
class _Overlap:
    """What photographs show of directions that two or more of them show; O sights of K directions by V cameras."""

    num_views: int
    view: Int[Tensor, "O"]
    direction: Int[Tensor, "O"]  # its number
    colour: Float[Tensor, "O 3"]
    turns: Float[Tensor, "O 3 3"]  # derivatives of the colours by their camera's turns
    lens: Float[Tensor, "O 3 L"]  # and by the lens


def _overlap(
    camera: RefinedCamera,
    cameras: Cameras,
    pictures: Float[Tensor, "V 3 h w"],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
    blur: float,
    num: int,
    generator: torch.Generator,
) -> _Overlap | None:
    """Directions that are drawn of each photograph's sky, in all photographs that show them."""
    (height, width), num_views = pictures.shape[-2:], len(pictures)
    small = camera.believed(cameras).resized(width, height)
    sky = torch.stack([of_sky(small.image_rays(view)) for view in range(num_views)]).view(num_views, 1, height, width)
    share = _blurred(sky.to(pictures), blur)
    pictures = _blurred(pictures * sky, blur) / share.clamp(min=_TINY)
    usable = sky & (share > _OF_SKY)
    # Pixels are drawn of each view, the same number where it has so many.
    order = torch.rand(num_views, height * width, generator=generator).to(pictures) + ~usable.flatten(1)
    drawn = order.argsort(1)[:, :num]
    views = torch.arange(num_views, device=drawn.device)[:, None]
    pixels = (views * height * width + drawn)[usable.flatten(1).gather(1, drawn)]
    directions = pixel_rays(small, pixels).directions
    far = replace(small, camera_to_world=F.pad(small.camera_to_world[..., :3], (0, 1)))
    place, depth = far.project(directions)
    column, row = place.floor().long().unbind(-1)
    seen = (depth > 0) & (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    seen &= usable[views, 0, row, column]
    seen &= seen.sum(0) > 1
    view, direction = seen.nonzero(as_tuple=True)
    if len(view) == 0:
        return None

    def sampled(directions: Float[Tensor, "K 3"]) -> Float[Tensor, "O 3"]:
        return _sample(pictures, view, far.project(directions)[0][seen])

    across = 1 / small.fx.mean()
    by_direction = pictures.new_zeros(len(view), 3, 3)
    for axis in axes_across(directions):
        ends = [sampled(directions + side * across * axis) for side in (0.5, -0.5)]
        by_direction += ((ends[0] - ends[1]) / across)[..., None] * axis[direction, None]
    # The ray of the data's camera that is believed to go there; what is seen there moves the other way.
    place = place[seen] * place.new_tensor([cameras.width / width, cameras.height / height])
    pixel = place.floor()
    rays = cameras.rays(view, pixel[:, 1], pixel[:, 0], place - pixel)
    slopes = -camera.slopes(rays, view, torch.zeros_like(by_direction), by_direction)
    return _Overlap(num_views, view, direction, sampled(directions), slopes[..., :3], slopes[..., 6:])


def _sample(
    pictures: Float[Tensor, "V 3 h w"], view: Int[Tensor, "O"], place: Float[Tensor, "O 2"]
) -> Float[Tensor, "O 3"]:
    """Colours at places (column, row), whole numbers at pixels' corners; linear between pixels."""
    height, width = pictures.shape[-2:]
    low = (place - 0.5).floor()
    share = place - 0.5 - low
    column, row = low.long().unbind(-1)
    found = pictures.new_zeros(len(view), 3)
    for right in (0, 1):
        for below in (0, 1):
            weight = (share[:, 0] if right else 1 - share[:, 0]) * (share[:, 1] if below else 1 - share[:, 1])
            at = (row + below).clamp(0, height - 1), (column + right).clamp(0, width - 1)
            found += weight[:, None] * pictures[view, :, at[0], at[1]]
    return found


def _equations(
    overlap: _Overlap, gains: Float[Tensor, "V 3"], learn_gains: bool
) -> tuple[Float[Tensor, "N N"], Float[Tensor, "N"], float]:
    """Matrix and gradient of the normal equations with the sky eliminated, and the variance of the colours.

    Their numbers are three turns of each view, the lens, and three logarithms of gains of each view, if these learn.
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
    slopes, places = [torch.cat([overlap.turns, overlap.lens], -1) * gains[view][..., None]], [of_view]
    places.append(of_lens.expand(num, -1))
    if learn_gains:
        slopes.append(torch.diag_embed(colour))
        places.append(3 * overlap.num_views + num_lens + of_view)
    values, columns = torch.cat(slopes, -1).double().cpu(), torch.cat(places, -1).cpu()
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
