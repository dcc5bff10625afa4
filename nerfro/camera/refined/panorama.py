"""Alignment of camera rotations by the panorama of a distant sky.

The radiance of the sky in each direction is the mean of the photographs that show this direction, and is therefore
eliminated. The unknowns are three rotation parameters per camera, and each Gauss-Newton step solves for all cameras. If
the sky were trained together with the cameras, each camera would stay where the sky has reproduced its photograph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from nerfro.camera.refined.gauss_newton import TINY, PriorInformation, axes_across, robust_weights, shortened
from nerfro.camera.refined.refined import RefinedCamera
from nerfro.core.cameras import Cameras
from nerfro.core.light import to_linear
from nerfro.core.progress import track
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.rays import Rays
from nerfro.samplers.subdivision import pixel_rays


@dataclass(frozen=True)
class PanoramaLevel:
    """Gauss-Newton steps with one blur of the photographs.

    Attributes:
        blur: standard deviation, as a fraction of the image width.
        num_directions: number of directions that each photograph contributes.
        repetitions: number of steps.
    """

    blur: float
    num_directions: int
    repetitions: int


@dataclass(frozen=True)
class PanoramaSettings(AlgorithmSettings):
    """Settings of the alignment of cameras by the panorama of the sky (`align`).

    Attributes:
        levels: steps from coarse to fine: the blur limits the details, and thereby the distance over which derivatives
            are valid.
        max_directions: largest number of directions of all photographs together, which bounds the memory.
        width: photographs are downscaled to this width in pixels; the alignment is accurate to a few hundredths of a
            pixel.
        min_blur: smallest standard deviation of the blur, in pixels.
        min_sky: smallest fraction of sky in a blurred pixel.
        scale: scale of the robust loss (see `robust_weights`), in square roots of linear radiance.
        reweightings: number of estimates of the robust weights in each step.
        damping: damping relative to the diagonal, which keeps cameras fixed that share no direction with others.
        min_deviation: smallest standard deviation of colours: half an 8-bit level.
    """

    levels: tuple[PanoramaLevel, ...] = (
        PanoramaLevel(1 / 32, 150, 4),
        PanoramaLevel(1 / 64, 150, 3),
        PanoramaLevel(1 / 128, 200, 3),
        PanoramaLevel(0.0, 300, 3),
    )
    max_directions: int = 30_000
    width: int = 256
    min_blur: float = 0.7
    min_sky: float = 0.9
    scale: float = 0.1
    reweightings: int = 2
    damping: float = 1e-2
    min_deviation: float = 0.5 / 255


@torch.no_grad()
def align(
    camera: RefinedCamera,
    cameras: Cameras,
    photographed: Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
    settings: PanoramaSettings = PanoramaSettings(),
) -> PriorInformation | None:
    """Rotate the cameras, and adapt the common lens if it is refined, until photographs of the sky agree.

    Args:
        camera: estimated cameras, changed in place.
        cameras: cameras of the data set.
        photographed: colours of pixels in the photographs, sRGB in [0, 1].
        of_sky: whether rays reach the sky without meeting the object.
        settings: steps and limits.

    Returns:
        Prior information about rotations and lens, except for a common rotation of all cameras. None if no two
        photographs show the same part of the sky.
    """
    settings.use()
    images = _downscaled_roots(cameras, photographed, settings.width)
    gains, generator = images.new_ones(len(cameras), 3), torch.Generator().manual_seed(0)
    information = None
    steps = [level for level in settings.levels for _ in range(level.repetitions)]
    for level in track("panorama", steps):
        blur = max(level.blur * images.shape[-1], settings.min_blur)
        usable_images = _blurred_sky(camera.estimated(cameras), images, of_sky, blur, settings.min_sky)
        num_directions = min(level.num_directions, settings.max_directions // len(cameras))
        overlap = _find_overlap(camera, cameras, *usable_images, num_directions, generator)
        if overlap is None:
            continue  # if little sky is visible, strongly blurred pixels always contain other objects
        matrix, vector, variance = _equations(overlap, gains, camera.exposure is not None, settings)
        step = _solve(matrix, vector, settings.damping).to(images)
        num = 3 * len(cameras) + overlap.by_camera.shape[-1] - 3  # rotations and lens
        rotations, lens, log_gains = step.tensor_split((3 * len(cameras), num))
        gains = gains * log_gains.exp().view(-1, 3) if len(log_gains) else gains
        rotations = shortened(rotations.view(-1, 3), 2 * blur * cameras.width / images.shape[-1])
        camera.move(F.pad(rotations, (0, 3)), lens)
        information = _marginalized(matrix, num, settings.damping)
        information = information / max(variance, settings.min_deviation**2)
    return None if information is None else _prior(camera, information)


def _prior(camera: RefinedCamera, information: Float[Tensor, "M M"]) -> PriorInformation:
    """Convert information about all rotations and the lens to a prior of all parameters."""
    # The photographs do not determine a common rotation of all cameras.
    common = camera.common_rotations().to(information)
    projection = torch.eye(len(information)).to(information)
    projection[: len(common), : len(common)] -= common @ common.mT
    mean = camera.parameter_vector()
    motions, lens = camera.split(torch.arange(len(mean), device=information.device))
    index = torch.cat([motions[:, :3].flatten(), lens])
    of_all = information.new_zeros(len(mean), len(mean))
    of_all[index[:, None], index] = projection @ information @ projection
    return PriorInformation(mean, of_all.to(mean))


def _solve(
    matrix: Float[Tensor, "parameters parameters"], right: Float[Tensor, " parameters *columns"], damping: float
) -> Float[Tensor, " parameters *columns"]:
    """Return the damped Gauss-Newton step for a normal matrix and a gradient."""
    return -torch.linalg.solve(matrix + torch.diag(damping * matrix.diagonal() + TINY), right)


def _marginalized(matrix: Float[Tensor, "parameters parameters"], num: int, damping: float) -> Float[Tensor, "M M"]:
    """Return the information about the first `num` parameters, with the others eliminated (Schur complement)."""
    own, mixed = matrix[:num, :num], matrix[num:, :num]
    return own + mixed.mT @ _solve(matrix[num:, num:], mixed, damping) if len(mixed) else own


def _downscaled_roots(
    cameras: Cameras, photographed: Callable[[Tensor], Tensor], max_width: int
) -> Float[Tensor, "V 3 h w"]:
    """Return square roots of linear radiance, at most `max_width` wide, in which exposures are factors as well."""
    height, width = cameras.height, cameras.width
    factor = min(1.0, max_width / width)
    size = max(1, round(factor * height)), max(1, round(factor * width))
    pixels = torch.arange(height * width, device=cameras.device)
    images = []
    for view in range(len(cameras)):
        image = photographed(view * height * width + pixels).clamp(0, 1).view(1, height, width, 3).permute(0, 3, 1, 2)
        images.append(F.interpolate(to_linear(image.float()), size, mode="area").sqrt())
    return torch.cat(images)


def _blurred(images: Float[Tensor, "V C h w"], deviation: float) -> Float[Tensor, "V C h w"]:
    """Convolve images with a Gaussian; pixels outside the images are black."""
    deviations = 0, 0, deviation, deviation
    blurred = scipy.ndimage.gaussian_filter(
        images.cpu().numpy(), deviations, mode="constant", radius=int(3 * deviation) + 1
    )
    return torch.from_numpy(blurred).to(images)


@dataclass(frozen=True)
class _Overlap:
    """O observations of K directions by V cameras; each direction is observed at least twice.

    Attributes:
        view: index of the camera of each observation.
        direction: index of the direction of each observation.
        colour: blurred colours.
        by_camera: derivatives of the colours by the rotation of the camera, followed by those by the lens.
    """

    view: Int[Tensor, "O"]
    direction: Int[Tensor, "O"]
    colour: Float[Tensor, "O 3"]
    by_camera: Float[Tensor, "O 3 columns"]


def _find_overlap(
    camera: RefinedCamera,
    cameras: Cameras,
    images: Float[Tensor, "V 3 h w"],
    usable: Bool[Tensor, "V 1 h w"],
    num: int,
    generator: torch.Generator,
) -> _Overlap | None:
    """Draw directions of the sky in each photograph, and find their colours in all photographs that show these.

    Args:
        camera: estimated cameras.
        cameras: cameras of the data set.
        images: downscaled and blurred photographs.
        usable: whether pixels of these images show the sky.
        num: number of directions per photograph.
        generator: random numbers.

    Returns:
        The observations; None if no direction is visible in two photographs.
    """
    height, width = images.shape[-2:]
    estimated = camera.estimated(cameras).resized(width, height)
    directions = _draw_directions(estimated, usable, num, generator)
    # The sky is infinitely far away, so the positions of the cameras do not matter.
    distant = replace(estimated, camera_to_world=F.pad(estimated.camera_to_world[..., :3], (0, 1)))
    # View by view, because most directions are outside of most views.
    views = [distant.select([view]) for view in range(len(images))]
    visible = torch.cat([_visible(one, directions, usable[[view]]) for view, one in enumerate(views)])
    visible &= visible.sum(0) > 1
    view, direction = visible.nonzero(as_tuple=True)
    if len(view) == 0:
        return None

    def positions(directions: Float[Tensor, "directions 3"]) -> Float[Tensor, "O 2"]:
        return torch.cat([one.project(directions)[0][0, seen] for one, seen in zip(views, visible, strict=True)])

    def sampled(directions: Float[Tensor, "directions 3"]) -> Float[Tensor, "O 3"]:
        return _sample(images, view, positions(directions))

    angle = 1 / estimated.fx.mean()  # of a pixel
    by_direction = images.new_zeros(len(view), 3, 3)
    for axis in axes_across(directions):
        ends = [sampled(directions + side * angle * axis) for side in (0.5, -0.5)]
        by_direction += ((ends[0] - ends[1]) / angle)[..., None] * axis[direction, None]
    # A rotation of the camera moves the image in the opposite direction, hence the negative sign.
    position = positions(directions)
    colour = _sample(images, view, position)
    position = position * position.new_tensor([cameras.width / width, cameras.height / height])
    pixel = position.floor()
    rays = cameras.rays(view, pixel[:, 1], pixel[:, 0], position - pixel)
    slopes = -camera.slopes(rays, view, torch.zeros_like(by_direction), by_direction)
    return _Overlap(view, direction, colour, torch.cat([slopes[..., :3], slopes[..., 6:]], -1))


def _blurred_sky(
    cameras: Cameras,
    images: Float[Tensor, "V 3 h w"],
    of_sky: Callable[[Rays], Bool[Tensor, "R"]],
    blur: float,
    min_sky: float,
) -> tuple[Float[Tensor, "V 3 h w"], Bool[Tensor, "V 1 h w"]]:
    """Blur the sky in images without mixing it with the object; also returns which pixels show enough of the sky."""
    cameras = cameras.resized(images.shape[-1], images.shape[-2])
    size = len(images), 1, *images.shape[-2:]
    sky = torch.stack([of_sky(cameras.image_rays(view)) for view in range(len(images))]).view(size)
    fraction = _blurred(sky.to(images), blur)
    return _blurred(images * sky, blur) / fraction.clamp(min=TINY), sky & (fraction > min_sky)


def _draw_directions(
    cameras: Cameras, usable: Bool[Tensor, "V 1 h w"], num: int, generator: torch.Generator
) -> Float[Tensor, "directions 3"]:
    """Draw at most `num` usable pixels of each view without repetition, and return the directions of their rays."""
    flat = usable.flatten(1)
    # Unusable pixels come last.
    order = torch.rand(*flat.shape, generator=generator).to(flat.device) + ~flat
    drawn = order.argsort(1)[:, :num]
    views = torch.arange(len(flat), device=drawn.device)[:, None]
    return pixel_rays(cameras, (views * flat.shape[1] + drawn)[flat.gather(1, drawn)]).directions


def _visible(
    cameras: Cameras, directions: Float[Tensor, "directions 3"], usable: Bool[Tensor, "V 1 h w"]
) -> Bool[Tensor, "V directions"]:
    """Test whether directions are seen at usable pixels away from the border."""
    position, depth = cameras.project(directions)
    height, width = usable.shape[-2:]
    column, row = position.floor().long().unbind(-1)
    visible = (depth > 0) & (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    views = torch.arange(len(usable), device=usable.device)[:, None]
    return visible & usable[views, 0, row.clamp(0, height - 1), column.clamp(0, width - 1)]


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
    overlap: _Overlap, gains: Float[Tensor, "V 3"], learn_gains: bool, settings: PanoramaSettings
) -> tuple[Float[Tensor, "parameters parameters"], Float[Tensor, " parameters"], float]:
    """Compute matrix and gradient of the normal equations with the sky eliminated, and the variance of the colours.

    The objective is the sum of w |g_v I_v(d_k) - c_k|^2 over all observations, minimized over the colours c_k of the
    sky, where I_v(d_k) is the colour of direction d_k in view v, g_v the gain of the view, and w a robust weight. The
    optimal c_k are weighted means. With the derivatives J of g_v I_v by the parameters and the matrix 1 that assigns
    observations to directions, their elimination gives

        J^T W J - J^T W 1 (1^T W 1)^-1 1^T W J

    and the gradient J^T W r with r = g_v I_v(d_k) - c_k. Weights and means alternate (iteratively reweighted least
    squares). The gradient uses the means of the previous weights, for which 1^T W r vanishes only approximately.

    The parameters are three rotations per view, the lens, and, with `learn_gains`, three logarithmic gains per view.
    """
    view, direction, num = overlap.view, overlap.direction, len(overlap.view)
    colour, weight, num_directions = overlap.colour * gains[view], gains.new_ones(num), int(direction.max()) + 1
    for _ in range(settings.reweightings):
        total = weight.new_zeros(num_directions).index_add(0, direction, weight).clamp(min=TINY)
        mean = colour.new_zeros(num_directions, 3).index_add(0, direction, weight[:, None] * colour) / total[:, None]
        error = colour - mean[direction]
        weight = robust_weights(error, settings.scale)
    total = weight.new_zeros(num_directions).index_add(0, direction, weight).clamp(min=TINY)

    of_view, num_lens = torch.arange(3, device=view.device) + 3 * view[:, None], overlap.by_camera.shape[-1] - 3
    of_lens = gains.numel() + torch.arange(num_lens, device=view.device).expand(num, -1)
    slopes, indices = [overlap.by_camera * gains[view][..., None]], [of_view, of_lens]
    if learn_gains:
        slopes.append(torch.diag_embed(colour))
        indices.append(gains.numel() + num_lens + of_view)
    values, columns = torch.cat(slopes, -1).double().cpu(), torch.cat(indices, -1).cpu()
    rows = torch.arange(3 * num).view(num, 3, 1).expand(values.shape)
    columns = columns[:, None].expand(values.shape)
    size = 3 * num, gains.numel() * (2 if learn_gains else 1) + num_lens
    jacobian = scipy.sparse.csr_matrix((values.flatten(), (rows.flatten(), columns.flatten())), size)

    weight, total, direction = (tensor.cpu() for tensor in (weight.double(), total.double(), direction))
    root = np.repeat(weight.sqrt().numpy(), 3)  # W^1/2
    sky_weights = np.repeat((weight / total[direction].sqrt()).numpy(), 3)
    channels = (3 * direction[:, None] + torch.arange(3)).flatten()
    # (1^T W 1)^-1/2 1^T W
    eliminated = scipy.sparse.csr_matrix((sky_weights, (channels, np.arange(3 * num))), (3 * num_directions, 3 * num))
    weighted, common = scipy.sparse.diags(root) @ jacobian, eliminated @ jacobian
    matrix = torch.from_numpy((weighted.T @ weighted - common.T @ common).toarray())
    residual = root * error.double().cpu().flatten().numpy()
    variance = float(residual @ residual / (root @ root))
    return matrix, torch.from_numpy(weighted.T @ residual), variance
