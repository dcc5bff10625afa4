"""Pinhole cameras, ideal or with a distorting lens, and their rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.lens import distort_without_fold, undistort
from nerfro.core.rays import Rays, in_room

# The up direction is an axis of the world if the mean up direction of the photographs is closer than this to the axis.
_MIN_AXIS_COSINE = math.cos(math.radians(15))
# Cameras have a common up direction if the mean of their unit up directions is at least this long.
MIN_MEAN_UP = 0.1


class Window(NamedTuple):
    """A rectangle of pixels."""

    top: int
    left: int
    height: int
    width: int

    def cut(self, images: Shaped[Tensor, "V H W *C"]) -> Shaped[Tensor, "V h w *C"]:
        """Crop the window from images."""
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return images[:, rows, columns].contiguous()


def up_direction(upward: Float[Tensor, "V 3"]) -> Float[Tensor, "3"]:
    """Estimate the up direction of the world: the mean over the cameras, or a world axis close to the mean.

    Args:
        upward: direction from the centre of each image to its upper edge, in world space.
    """
    mean = upward.mean(0).cpu()
    if float(mean.norm()) < MIN_MEAN_UP:
        return torch.tensor([0.0, 0.0, 1.0])
    up = torch.nn.functional.normalize(mean, dim=0)
    axis = torch.eye(3).to(up)[up.abs().argmax()] * up[up.abs().argmax()].sign()
    return axis if float(up @ axis) > _MIN_AXIS_COSINE else up


def central_window(height: int, width: int, fraction: float) -> Window:
    """Return the window of even sides around the centre of an image that spans `fraction` of each side, in (0, 1]."""
    if not 0 < fraction <= 1:
        raise NerfroError(f"a central crop of {fraction} of the image is impossible; give a fraction in (0, 1]")
    if fraction == 1:
        return Window(0, 0, height, width)
    # Half sides are truncated, as in the authors' code, so that the window is symmetric.
    half_height, half_width = int(height // 2 * fraction), int(width // 2 * fraction)
    if half_height == 0 or half_width == 0:
        raise NerfroError(f"a central crop of {fraction} leaves nothing of {width}x{height} pixels; take a larger one")
    return Window(height // 2 - half_height, width // 2 - half_width, 2 * half_height, 2 * half_width)


def room_rotations(
    camera_to_world: Float[Tensor, "*V 3 columns"], turntable: bool | tuple[float, ...]
) -> Float[Tensor, "*V 3 3"]:
    """Return the rotation from the world of an object on a turntable to the room, for each camera.

    The x axis of the room points from the object to the camera, y to the right in the image and z up. With an axis of
    rotation, z is this axis, so that cameras in one vertical plane see the room alike.

    Args:
        camera_to_world: poses relative to the object, OpenGL axes.
        turntable: axis of rotation in the world, upwards; True for the vertical direction of each image.

    Raises:
        NerfroError: a camera is turned on its side with respect to the axis, so that its azimuth is unknown.
    """
    right, up = camera_to_world[..., 0], camera_to_world[..., 1]
    if not isinstance(turntable, bool):
        up = torch.nn.functional.normalize(right.new_tensor(turntable), dim=0).expand_as(right)
    across = right - (right * up).sum(-1, keepdim=True) * up
    if bool((across.norm(dim=-1) < 0.1).any()):
        raise NerfroError(
            f"data.turntable_axis={turntable}: the horizontal axis of an image is parallel to the axis of rotation; "
            "turn the camera upright, or take data.turntable=true for a camera that stands still"
        )
    right = torch.nn.functional.normalize(across, dim=-1)
    return torch.stack([torch.linalg.cross(right, up), right, up], -2)


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras of one resolution.

    A camera looks along its -z axis, x is right and y is up (OpenGL). Pixel (row i, column j) covers the square from
    (j, i) to (j + 1, i + 1) of the image plane, so the centre of the pixel is (j + .5, i + .5).

    Attributes:
        camera_to_world: rotation and centre [R | o], world units.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels from the image's left and top edge.
        width, height: resolution, pixels.
        near, far: arc length from the camera's centre at which rays begin and end, world units.
        distortion: lens distortion, see `nerfro.core.lens.coefficients`; None for an ideal lens.
        turntable: whether the object turns before a camera that stands still, so that the background depends on
            directions relative to the camera; for cameras at several heights, the axis of rotation in the world.
    """

    camera_to_world: Float[Tensor, "V 3 4"]
    fx: Float[Tensor, "V"]
    fy: Float[Tensor, "V"]
    cx: Float[Tensor, "V"]
    cy: Float[Tensor, "V"]
    width: int
    height: int
    near: float
    far: float
    distortion: Float[Tensor, "V 9"] | None = None
    turntable: bool | tuple[float, ...] = False

    def __len__(self) -> int:
        return self.camera_to_world.shape[0]

    @property
    def device(self) -> torch.device:
        return self.camera_to_world.device

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Cameras:
        """Move the cameras to a device, or convert to a precision."""
        return self._each(lambda tensor: tensor.to(device, dtype))

    def select(self, views: list[int]) -> Cameras:
        """Select cameras, in the given order."""
        return self._each(lambda tensor: tensor[views])

    def relative_to(self, origin: Float[np.ndarray, "3"]) -> Cameras:
        """Return the cameras in coordinates with another origin."""
        poses = self.camera_to_world.double()
        poses[:, :, 3] -= torch.from_numpy(origin).to(poses)
        return replace(self, camera_to_world=poses.to(self.camera_to_world))

    def refuse_turntable(self, reason: str, advice: str) -> None:
        """Refuse cameras of a turntable, with a reason and what to do instead."""
        if self.turntable:
            raise NerfroError(f"{reason}, but the object turns on a turntable (data.turntable); {advice}")

    @classmethod
    def joined(cls, parts: Sequence[Cameras]) -> Cameras:
        """Join cameras of one image size; the bounds of the rays are those of the first part."""
        names = ("camera_to_world", "fx", "fy", "cx", "cy")
        tensors: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        if any(part.distortion is not None for part in parts):
            lenses = [torch.zeros(len(part), 9) if part.distortion is None else part.distortion for part in parts]
            tensors["distortion"] = torch.cat(lenses)
        return replace(parts[0], **tensors)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        changed: dict[str, Any] = {name: change(x) for name, x in vars(self).items() if torch.is_tensor(x)}
        return replace(self, **changed)

    def crop(self, window: Window) -> Cameras:
        """Crop the images to a window; pixel (0, 0) of the result is pixel (top, left) of these cameras."""
        return replace(
            self, cx=self.cx - window.left, cy=self.cy - window.top, width=window.width, height=window.height
        )

    def resized(self, width: int, height: int) -> Cameras:
        """Change the resolution of the images, in pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y)

    def rays(
        self,
        view: Int[Tensor, "R"],
        row: Int[Tensor, "R"] | Float[Tensor, "R"],
        column: Int[Tensor, "R"] | Float[Tensor, "R"],
        place: Float[Tensor, "R 2"] | Float[Tensor, "2"] | None = None,
    ) -> Rays:
        """Make rays through pixels.

        The radius of a pixel's cone is 2 / sqrt(12) of the pixel's width (mip-NeRF, section 3.1: the disc has the
        variance of the pixel). The width is 1 / fx at unit depth, at distance |d| along the ray
        d = ((u - cx) / fx, -(v - cy) / fy, -1), and 1 / (fx |d|) at unit distance. Lens distortion changes the area of
        the pixel, and the radius with the square root of the area.

        Args:
            view, row, column: indices of each pixel, on the device of the cameras.
            place: position (x, y) of the ray from the left and top edge of each pixel, in pixels; None for the centre.

        Returns:
            Rays in world space with unit directions.
        """
        fx = self.fx[view]
        # Not in PyTorch's default type, which Lightning changes temporarily while another thread makes rays.
        offset_x, offset_y = (0.5, 0.5) if place is None else place.to(fx).unbind(-1)
        row, column = row.to(fx), column.to(fx)
        x = (column + offset_x - self.cx[view]) / fx
        y = (self.cy[view] - row - offset_y) / self.fy[view]
        width = 1 / fx
        if self.distortion is not None:
            ideal, area = undistort(torch.stack([x, -y], -1), self.distortion[view])
            x, y = ideal[:, 0], -ideal[:, 1]
            width = width * area.clamp(min=0).sqrt()
        directions = torch.stack([x, y, -torch.ones_like(x)], -1)
        length = torch.linalg.vector_norm(directions, dim=-1)
        pose = self.camera_to_world[view]
        directions = (pose[..., :3] * directions[:, None]).sum(-1)  # mixed precision would round a matrix product
        # Normalized in world space, because the rotation in a file is rounded.
        return Rays(
            origins=pose[..., 3],
            directions=torch.nn.functional.normalize(directions, dim=-1),
            radii=2 / math.sqrt(12) * width / length,
            near=torch.full_like(x, self.near),
            far=torch.full_like(x, self.far),
            room=room_rotations(self.camera_to_world, self.turntable)[view] if self.turntable else None,
        )

    def project(
        self, points: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, "V points 2"], Float[Tensor, "V points"]]:
        """Project points of the world into the images.

        Returns:
            Pixel coordinates (column, row), integers at the corners of pixels, and depth along the optical axis in
            world units. Pixel coordinates are invalid at depth 0 or less. Points beyond the radius at which the lens
            model folds back lie outside the image.
        """
        offset = points - self.camera_to_world[:, None, :, 3]
        right, up, back = (offset @ self.camera_to_world[:, :, :3]).unbind(-1)
        x, y = right / -back, up / back
        if self.distortion is not None:
            x, y = distort_without_fold(torch.stack([x, y], -1), self.distortion).unbind(-1)
        columns = self.fx[:, None] * x + self.cx[:, None]
        rows = self.fy[:, None] * y + self.cy[:, None]
        return torch.stack([columns, rows], -1), -back

    def view_of(self, pixels: Int[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
        """Return the view of each pixel, given its number view * H * W + row * W + column."""
        return pixels // (self.height * self.width)

    def image_rays(self, view: int) -> Rays:
        """Make rays through all pixel centres of a view, row by row."""
        return self._window_rays(view, Window(0, 0, self.height, self.width))

    def tile(self, size: int, draws: Draws) -> Float[Tensor, "T T 3"]:
        """Make unit viewing directions, towards the background, of a random window of a random view.

        Args:
            size: side of the window in pixels, at most the shorter side of the image.
            draws: random numbers for the choice of view and window.
        """
        side = min(size, self.height, self.width)
        # Drawn on the CPU, so that the host does not wait for the device of the cameras.
        words = draws.words(torch.zeros(1, dtype=torch.long), 3, "tile")[0].tolist()
        counts = len(self), self.height - side + 1, self.width - side + 1
        view, top, left = (word * count >> 32 for word, count in zip(words, counts, strict=True))
        rays = self._window_rays(view, Window(top, left, side, side))
        return in_room(rays.directions, rays.room).reshape(side, side, 3)

    def _window_rays(self, view: int, window: Window) -> Rays:
        row, column = torch.meshgrid(
            torch.arange(window.top, window.top + window.height, device=self.device),
            torch.arange(window.left, window.left + window.width, device=self.device),
            indexing="ij",
        )
        return self.rays(torch.full_like(row, view).flatten(), row.flatten(), column.flatten())
