"""Motions of cameras that move pixels alike, and those of the whole world, which no picture shows."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.geometry.lines import nearest_point

_GRID = 9  # places along each side of an image
_NEAREST = 1e-3  # of far, where cameras stand where they look
_RANK = 1e-6  # of the largest singular value: below, directions are not independent


def object_distances(cameras: Cameras) -> Float[Tensor, "V"]:
    """How far each camera is from what all look at, within the bounds of its rays."""
    poses = cameras.camera_to_world.double().cpu()
    point = torch.from_numpy(nearest_point(poses[..., 3].numpy(), -poses[..., 2].numpy()))
    distances = (poses[..., 3] - point).norm(dim=-1)
    least = max(cameras.near, _NEAREST * (cameras.far if math.isfinite(cameras.far) else float(distances.max()) or 1.0))
    return distances.clamp(min=least, max=cameras.far)


def pixel_motions(cameras: Cameras, distances: Float[Tensor, "V"]) -> Float[Tensor, "V 7"]:
    """Root mean square over a view of how far points at a distance move in it, pixels.

    For a turn of the camera by a radian about each of its axes, a shift by a world unit along each, and a focal length
    that grows by its own. A point (x, y, -1) D moves by -w x X - t, and its image by f (dX + x dZ) / D (CamP, Park et
    al., 2023, section 4, of which this is the diagonal).
    """
    ticks = (torch.arange(_GRID, dtype=torch.float64) + 0.5) / _GRID
    place = torch.cartesian_prod(ticks, ticks)
    fx, fy, cx, cy = (getattr(cameras, name).double().cpu()[:, None] for name in ("fx", "fy", "cx", "cy"))
    x, y = (place[:, 0] * cameras.width - cx) / fx, (cy - place[:, 1] * cameras.height) / fy
    points = torch.stack([x, y, -torch.ones_like(x)], -1) * distances[:, None, None]
    axes = torch.eye(3, dtype=points.dtype)
    turned = -torch.linalg.cross(axes.expand(*x.shape, 3, 3), points[:, :, None].expand(*x.shape, 3, 3))
    moved = torch.cat([turned, (-axes).expand_as(turned)], 2) / distances[:, None, None, None]
    du = fx[..., None] * (moved[..., 0] + x[..., None] * moved[..., 2])
    dv = fy[..., None] * (moved[..., 1] + y[..., None] * moved[..., 2])
    squares = torch.cat([du.square() + dv.square(), ((fx * x).square() + (fy * y).square())[..., None]], -1)
    return squares.mean(1).sqrt()


def even_weights(motions: Float[Tensor, "V 7"]) -> Float[Tensor, "V 6"]:
    """Pixels for a turn and for a shift of each camera, the same about and along all of its axes.

    Where cameras stand as a whole must not depend on which way is up in a picture, or straight ahead.
    """
    return torch.stack([motions[:, :2].mean(1), motions[:, 3:5].mean(1)], -1).repeat_interleave(3, -1)


def world_motions(poses: Float[Tensor, "V 3 4"], weights: Float[Tensor, "V 6"]) -> Float[Tensor, "K V 6"]:
    """Orthonormal motions of all cameras that a turn, a shift and a scaling of the world would cause.

    Args:
        poses: of the cameras.
        weights: of turns and shifts, along the cameras' own axes, with which motions are multiplied.
    """
    centres = poses[..., 3] - poses[..., 3].mean(0)
    axes = torch.eye(3, dtype=poses.dtype)[:, None].expand(3, *centres.shape)
    nothing = torch.zeros_like(axes)
    turns = torch.cat([axes, torch.linalg.cross(axes, centres.expand_as(axes))], -1)
    motions = torch.cat([turns, torch.cat([nothing, axes], -1), torch.cat([nothing[:1], centres[None]], -1)])
    own = motions.unflatten(-1, (2, 3)) @ poses[..., :3]  # along the cameras' own axes
    u, values, _ = torch.linalg.svd((own.flatten(-2) * weights).flatten(1).T, full_matrices=False)
    return u[:, values > _RANK * values.max()].T.unflatten(-1, (len(poses), 6))


def without_world(
    motion: Float[Tensor, "V 6"], of_world: Float[Tensor, "K V 6"], weights: Float[Tensor, "V 6"]
) -> Float[Tensor, "V 6"]:
    """Turns and shifts of cameras without what is common to all: none of `world_motions` is left in them."""
    weighted = motion * weights
    common = torch.einsum("kvi,vi->k", of_world, weighted)
    return (weighted - torch.einsum("kvi,k->vi", of_world, common)) / weights
