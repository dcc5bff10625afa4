"""Camera motions in units of pixels, and the gauge freedom of the cameras.

A similarity transformation of all cameras and the scene changes no image (gauge freedom). Its motions are removed from
the refinement of cameras.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.geometry.lines import nearest_point


def object_distances(cameras: Cameras) -> Float[Tensor, "V"]:
    """Return the distance of each camera from the point nearest to all optical axes, within near and far.

    A distance is at least 0.1 % of the far bound.
    """
    poses = cameras.camera_to_world.double().cpu()
    point = torch.from_numpy(nearest_point(poses[..., 3].numpy(), -poses[..., 2].numpy()))
    distances = (poses[..., 3] - point).norm(dim=-1)
    scale = cameras.far if math.isfinite(cameras.far) else float(distances.max()) or 1.0
    return distances.clamp(min=max(cameras.near, 1e-3 * scale), max=cameras.far)


def pixel_motions(cameras: Cameras, distances: Float[Tensor, "V"]) -> Float[Tensor, "V 7"]:
    """Compute the image motion, in pixels, that a unit change of each camera parameter causes.

    The parameters are rotations about the three camera axes (radians), translations along these (world units), and the
    logarithm of the focal length. The result is the root mean square over the image for points at the given distance. A
    point X = (x, y, -1) D moves by -w x X - t, and its image by f (dX + x dZ) / D.

    Source:
        Park et al., "CamP: camera preconditioning for neural radiance fields", 2023, section 4 (diagonal).
    """
    num_points = 9  # along each side of an image
    ticks = (torch.arange(num_points, dtype=torch.float64) + 0.5) / num_points
    position = torch.cartesian_prod(ticks, ticks)
    fx, fy, cx, cy = (getattr(cameras, name).double().cpu()[:, None] for name in ("fx", "fy", "cx", "cy"))
    x, y = (position[:, 0] * cameras.width - cx) / fx, (cy - position[:, 1] * cameras.height) / fy
    points = torch.stack([x, y, -torch.ones_like(x)], -1) * distances[:, None, None]
    axes = torch.eye(3, dtype=points.dtype)
    rotated = -torch.linalg.cross(axes.expand(*x.shape, 3, 3), points[:, :, None].expand(*x.shape, 3, 3))
    moved = torch.cat([rotated, (-axes).expand_as(rotated)], 2) / distances[:, None, None, None]
    du = fx[..., None] * (moved[..., 0] + x[..., None] * moved[..., 2])
    dv = fy[..., None] * (moved[..., 1] + y[..., None] * moved[..., 2])
    squares = torch.cat([du.square() + dv.square(), ((fx * x).square() + (fy * y).square())[..., None]], -1)
    return squares.mean(1).sqrt()


def even_weights(motions: Float[Tensor, "V 7"]) -> Float[Tensor, "V 6"]:
    """Average `pixel_motions` over axes, into one weight for rotations and one for translations of each camera.

    With equal weights for all axes, the removal of the gauge freedom does not depend on the orientation of the cameras.
    """
    return torch.stack([motions[:, :2].mean(1), motions[:, 3:5].mean(1)], -1).repeat_interleave(3, -1)


def gauge_basis(poses: Float[Tensor, "V 3 4"], weights: Float[Tensor, "V 6"]) -> Float[Tensor, "gauge V 6"]:
    """Compute an orthonormal basis of the gauge freedom: camera motions by similarity transformations of the world.

    Args:
        poses: camera-to-world matrices, world units.
        weights: weights of rotations and translations about and along the camera axes.

    Returns:
        Weighted motions; at most seven (three rotations, three translations and one scaling).
    """
    centres = poses[..., 3] - poses[..., 3].mean(0)
    axes = torch.eye(3, dtype=poses.dtype)[:, None].expand(3, *centres.shape)
    zeros = torch.zeros_like(axes)
    rotations = torch.cat([axes, torch.linalg.cross(axes, centres.expand_as(axes))], -1)
    # Translations by the typical distance of the scene have the size of the other motions in any world unit.
    distance = weights[:, :3].mean() / weights[:, 3:].mean()
    translations = torch.cat([zeros, distance * axes], -1)
    motions = torch.cat([rotations, translations, torch.cat([zeros[:1], centres[None]], -1)])
    own = motions.unflatten(-1, (2, 3)) @ poses[..., :3]  # in camera axes
    u, values, _ = torch.linalg.svd((own.flatten(-2) * weights).flatten(1).T, full_matrices=False)
    return u[:, values > 1e-6 * values.max()].T.unflatten(-1, (len(poses), 6))


def project_out_gauge(
    motion: Float[Tensor, "V 6"], basis: Float[Tensor, "gauge V 6"], weights: Float[Tensor, "V 6"]
) -> Float[Tensor, "V 6"]:
    """Remove the component in the space of `gauge_basis` from rotations and translations of cameras."""
    weighted = motion * weights
    common = torch.einsum("kvi,vi->k", basis, weighted)
    return (weighted - torch.einsum("kvi,k->vi", basis, common)) / weights
