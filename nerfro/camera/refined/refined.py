"""Camera model that refines poses and lens during training, with motions in units of pixels.

A similarity transformation of all cameras and the scene changes no image (gauge freedom). Its motions are removed from
the refinement of cameras, and `similarity` fits the transformation between two sets of cameras.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.camera.base import CameraModel, PerView
from nerfro.core.cameras import Cameras
from nerfro.core.lens import distort, undistort
from nerfro.core.rays import Rays
from nerfro.geometry.lines import nearest_point
from nerfro.registry.allowed import Natural
from nerfro.registry.registration import register


@register("camera", "refined")
class RefinedCamera(PerView, CameraModel):
    """Refine the pose of each training camera, and optionally the common lens, during training.

    The phase `cameras` moves the cameras. The motion that a similarity transformation of the world would cause (gauge
    freedom) is removed to first order, so that the world and the surface keep their place.

    Args:
        lens: whether to refine the focal length and the principal point, which all views share.
        exposure: whether to estimate a gain for each training view.
        appearance: size of the embedding of each training view, from which a smooth gain over its image is learned, in
            addition to its exposure; 0 for none.
        fix_gauge: whether to remove the gauge freedom. Disable this for cameras of a scene that is fixed.

    Attributes:
        motion: rotation and translation of each camera in its own axes, in units of pixels.
        lens: logarithmic focal length and principal point, in units of pixels; None if the lens is not refined.
        poses: camera-to-world matrices of the data set.
        focal, distortion: focal lengths and distortion coefficients of the data set.
        units: rotation or translation that moves the image by one pixel, for each parameter.
        weights: weights of the parameters for the gauge.
        gauge_basis: basis of the gauge freedom (see `gauge_basis`); empty if the gauge is not fixed.
        focal_unit: change of the logarithmic focal length that moves the image by one pixel.
    """

    moves = True
    lens: Float[Tensor, "3"] | None
    motion: Float[Tensor, "V 6"]
    poses: Float[Tensor, "V 3 4"]
    focal: Float[Tensor, "V 2"]
    distortion: Float[Tensor, "V 9"]
    units: Float[Tensor, "V 6"]
    weights: Float[Tensor, "V 6"]
    gauge_basis: Float[Tensor, "gauge V 6"]
    focal_unit: Float[Tensor, "1"]

    def __init__(
        self, lens: bool = False, exposure: bool = False, appearance: Natural = 0, fix_gauge: bool = True
    ) -> None:
        super().__init__(exposure, appearance)
        self.fix_gauge = fix_gauge
        for name in ("motion", "poses", "focal", "distortion", "units", "weights", "gauge_basis", "focal_unit"):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("lens", torch.zeros(3) if lens else None)

    def begin(self, cameras: Cameras) -> None:
        super().begin(cameras)
        # The derivatives of the refinement assume a background that is fixed in the world.
        cameras.refuse_turntable("camera=refined needs a fixed background", "take camera=given")
        poses = cameras.camera_to_world.double().cpu()
        pixels = pixel_motions(cameras, object_distances(cameras))
        weights = even_weights(pixels)
        distortion = torch.zeros(0, 9) if cameras.distortion is None else cameras.distortion
        buffers = {
            "motion": torch.zeros(len(cameras), 6),
            "poses": poses,
            "focal": torch.stack([cameras.fx, cameras.fy], -1),
            "distortion": distortion,
            "units": 1 / pixels[:, :6],
            "weights": weights,
            "gauge_basis": gauge_basis(poses, weights) if self.fix_gauge else weights.new_zeros(0, *weights.shape),
            "focal_unit": 1 / pixels[:, 6].square().mean().sqrt()[None],
        }
        for name, tensor in buffers.items():
            setattr(self, name, tensor.to(getattr(self, name)))

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        motion, axes = self.fixed_motion(), self.poses[view, :, :3]
        rotations, translations = rotation_matrices(motion[:, :3]), motion[:, 3:]
        local = (rays.directions[:, None] @ axes)[:, 0]
        if self.lens is not None:
            local = self._through_lens(local, view)
        directions = (axes @ (rotations[view] @ local[..., None]))[..., 0]
        origins = rays.origins + (axes @ translations[view, :, None])[..., 0]
        return replace(rays, origins=origins, directions=normalize(directions, dim=-1))

    def slopes(
        self,
        rays: Rays,
        view: Int[Tensor, "R"],
        by_origin: Float[Tensor, "R C 3"],
        by_direction: Float[Tensor, "R C 3"],
    ) -> Float[Tensor, "R C parameters"]:
        """Convert derivatives by rays to derivatives by camera parameters in pixels.

        Args:
            rays: rays of the cameras of the data set.
            view: index of the training view of each ray.
            by_origin: derivatives of C quantities by the origins of the estimated rays.
            by_direction: derivatives by the directions of the estimated rays.

        Returns:
            Derivatives by the six parameters of the camera, followed by three of the lens if it is refined.
        """
        axes, moved = self.poses[view, :, :3], self(rays, view)
        by_rotation = torch.linalg.cross(moved.directions[:, None].expand_as(by_direction), by_direction)
        by_motion = torch.cat([by_rotation @ axes, by_origin @ axes], -1) * self.units[view, None]
        if self.lens is None:
            return by_motion
        lens, by_lens = self.lens.clone(), []
        for number in range(len(lens)):  # central differences over one pixel
            ends = []
            for half in (0.5, -0.5):
                self.lens[number] = lens[number] + half
                ends.append(self(rays, view).directions)
            self.lens.copy_(lens)
            by_lens.append((by_direction * (ends[0] - ends[1])[:, None]).sum(-1))
        return torch.cat([by_motion, torch.stack(by_lens, -1)], -1)

    def fixed_motion(self) -> Float[Tensor, "V 6"]:
        """Return rotations (radians) and translations (world units) in the given camera axes, without gauge freedom."""
        return project_out_gauge(self.motion * self.units, self.gauge_basis, self.weights)

    def common_rotations(self) -> Float[Tensor, "M 3"]:
        """Return an orthonormal basis of common rotations of all cameras, each about its centre; units of pixels."""
        own = self.moved()[..., :3].mT / self.units[:, :3, None]
        return torch.linalg.qr(own.flatten(0, 1))[0]

    def moved(self) -> Float[Tensor, "V 3 4"]:
        """Return the estimated poses."""
        motion, axes = self.fixed_motion(), self.poses[..., :3]
        centres = self.poses[..., 3:] + axes @ motion[:, 3:, None]
        return torch.cat([axes @ rotation_matrices(motion[:, :3]), centres], -1)

    def parameter_vector(self) -> Float[Tensor, " parameters"]:
        """Return a copy of the parameters of all cameras in pixels, followed by the lens if it is refined."""
        return torch.cat([self.motion.flatten(), *([] if self.lens is None else [self.lens])])

    def split(self, parameters: Shaped[Tensor, " parameters"]) -> tuple[Shaped[Tensor, "V 6"], Shaped[Tensor, "L"]]:
        """Split a vector of parameters (see `parameter_vector`) into motions of the cameras and lens."""
        num = self.motion.numel()
        return parameters[:num].view(-1, 6), parameters[num:]

    def move(self, motion: Float[Tensor, "V 6"], lens: Float[Tensor, "L"]) -> None:
        """Add to the parameters of cameras and lens, in pixels."""
        self.motion.add_(motion)
        if self.lens is not None:
            self.lens += lens

    def restore(self, parameters: Float[Tensor, " parameters"], views: Bool[Tensor, "V"], lens: bool) -> None:
        """Restore earlier parameters (see `parameter_vector`) of some views, and of the lens if `lens` is true."""
        motion, old_lens = self.split(parameters)
        self.motion[views] = motion[views]
        if lens and self.lens is not None:
            self.lens.copy_(old_lens)

    def _through_lens(self, local: Float[Tensor, "R 3"], view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Return the directions, in camera axes, of the same pixels through the estimated lens."""
        growth, shift = self._lens()
        ideal = local[:, :2] / -local[:, 2:]
        flipped = ideal * ideal.new_tensor([1.0, -1.0])  # y down, as in the image
        distorted = len(self.distortion) > 0
        if distorted:
            flipped, _ = distort(flipped, self.distortion[view])
        flipped = (flipped - shift / self.focal[view]) / growth
        if distorted:
            flipped, _ = undistort(flipped, self.distortion[view])
        return torch.cat([flipped * ideal.new_tensor([1.0, -1.0]), -torch.ones_like(local[:, 2:])], -1)

    def _lens(self) -> tuple[Float[Tensor, ""], Float[Tensor, "2"]]:
        """Return the factor of the focal length, and the shift of the principal point in pixels."""
        assert self.lens is not None
        return torch.exp(self.lens[0] * self.focal_unit[0]), self.lens[1:]

    @torch.no_grad()
    def estimated(self, cameras: Cameras) -> Cameras:
        poses = self.moved().to(cameras.camera_to_world)
        return self._with_lens(replace(cameras, camera_to_world=poses))

    @torch.no_grad()
    def aligned(self, cameras: Cameras) -> Cameras:
        """Apply the similarity transformation of the training cameras, and the estimated lens, to other cameras."""
        old, new, weights = (x.double() for x in (self.poses, self.moved(), self.weights))
        transformation = similarity(old, new, weights[:, 0], weights[:, 3])
        poses = transformation.apply(cameras.camera_to_world.to(transformation.shift)).to(cameras.camera_to_world)
        return self._with_lens(replace(cameras, camera_to_world=poses))

    def _with_lens(self, cameras: Cameras) -> Cameras:
        if self.lens is None:
            return cameras
        growth, shift = (values.to(cameras.fx) for values in self._lens())
        x, y = cameras.cx + shift[0], cameras.cy + shift[1]
        return replace(cameras, fx=cameras.fx * growth, fy=cameras.fy * growth, cx=x, cy=y)

    @torch.no_grad()
    def measurements(self) -> dict[str, float]:
        motion = (self.fixed_motion() / self.units).square().sum(-1).mean().sqrt()
        values = super().measurements() | {"cameras.motion_pixels": float(motion)}
        if self.lens is not None:
            growth, (x, y) = self._lens()
            named = {"focal_length_factor": growth, "principal_x": x, "principal_y": y}
            values |= {f"cameras.{name}": float(value) for name, value in named.items()}
        return values


def rotation_matrices(vectors: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3 3"]:
    """Convert rotation vectors (axis times angle in radians) to rotation matrices."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return torch.linalg.matrix_exp(cross.view(-1, 3, 3))


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


class Similarity(NamedTuple):
    """Similarity transformation of the world, x -> scale * rotation x + shift."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]

    def apply(self, poses: Float[Tensor, "V 3 4"]) -> Float[Tensor, "V 3 4"]:
        """Transform camera-to-world matrices; the scale acts on the centres only."""
        centres = self.scale * poses[..., 3] @ self.rotation.T + self.shift
        return torch.cat([self.rotation @ poses[..., :3], centres[..., None]], -1)


def similarity(
    old: Float[Tensor, "V 3 4"],
    new: Float[Tensor, "V 3 4"],
    rotation_weights: Float[Tensor, "V"],
    shift_weights: Float[Tensor, "V"],
) -> Similarity:
    """Fit the similarity transformation from `old` to `new` cameras.

    The sum of squared weighted angles and distances between transformed and new cameras is minimal. In contrast to
    Umeyama (1991), who uses points only, camera axes determine the rotation even if the centres lie on a line.

    Args:
        old, new: camera-to-world matrices, world units.
        rotation_weights, shift_weights: weight of angle and distance of each camera.
    """
    turns, shifts = rotation_weights.square(), shift_weights.square()
    means = [(shifts[:, None] * poses[..., 3]).sum(0) / shifts.sum() for poses in (old, new)]
    before, after = (poses[..., 3] - mean for poses, mean in zip((old, new), means, strict=True))
    scale, rotation = torch.ones_like(shifts[0]), torch.eye(3).to(old)
    # Updates of rotation and scale alternate.
    for _ in range(10):
        # For small angles, the squared distance of two rotation matrices is twice the square of the angle.
        both = torch.einsum("v,vij,vkj->ik", 0.5 * turns, new[..., :3], old[..., :3])
        both = both + scale * torch.einsum("v,vi,vk->ik", shifts, after, before)
        u, _, v = torch.linalg.svd(both)
        sign = torch.linalg.det(u @ v)
        rotation = u @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ v
        spread = (shifts * before.square().sum(-1)).sum()
        along = (shifts * (after * (before @ rotation.T)).sum(-1)).sum()
        # Cameras at a single position do not determine the scale.
        scale = torch.where(spread > torch.finfo(spread.dtype).tiny, along / spread, torch.ones_like(spread))
    return Similarity(scale, rotation, means[1] - scale * rotation @ means[0])


def motion_between(
    old: Float[Tensor, "V 3 4"], new: Float[Tensor, "V 3 4"]
) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """Return the rotation angle of each camera in degrees, and the distance of its centres in world units."""
    old, new = old.double(), new.double()
    chord = (new[..., :3] - old[..., :3]).norm(dim=(-2, -1)) / math.sqrt(8)  # the sine of half the angle
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1))), (new[..., 3] - old[..., 3]).norm(dim=-1)
