"""Cameras that are refined with the scene."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.allowed import Count, Natural
from nerfro.camera.base import Camera
from nerfro.camera.per_view import PerView
from nerfro.camera.pixel_units import even_weights, object_distances, pixel_motions, without_world, world_motions
from nerfro.camera.similarity import similarity
from nerfro.cameras import Cameras
from nerfro.lens import distort, undistort
from nerfro.rays import Rays
from nerfro.registry import register


class _Motions(PerView):
    """Turn and shift of each camera along its own axes, counted in pixels; the world as a whole stays."""

    poses: Float[Tensor, "V 3 4"]
    focal: Float[Tensor, "V 2"]
    distortion: Float[Tensor, "V 9"]
    units: Float[Tensor, "V 6"]
    weights: Float[Tensor, "V 6"]
    of_world: Float[Tensor, "K V 6"]
    focal_unit: Float[Tensor, "1"]
    motion: Float[Tensor, "V 6"]

    def __init__(self, hold_world: bool = True) -> None:
        super().__init__()
        self.hold_world = hold_world
        shapes = {
            "motion": (6,),
            "poses": (3, 4),
            "focal": (2,),
            "distortion": (9,),
            "units": (6,),
            "weights": (6,),
            "of_world": (0, 6),
        }
        for name, shape in {**shapes, "focal_unit": ()}.items():
            self.register_buffer(name, torch.zeros(0, *shape))

    def begin(self, cameras: Cameras) -> None:
        poses = cameras.camera_to_world.double().cpu()
        pixels = pixel_motions(cameras, object_distances(cameras))
        weights = even_weights(pixels)
        distortion = torch.zeros(0, 9) if cameras.distortion is None else cameras.distortion
        found = {
            "motion": torch.zeros(len(cameras), 6),
            "poses": poses,
            "focal": torch.stack([cameras.fx, cameras.fy], -1),
            "distortion": distortion,
            "units": 1 / pixels[:, :6],
            "weights": weights,
            "of_world": world_motions(poses, weights) if self.hold_world else weights.new_zeros(0, *weights.shape),
            "focal_unit": 1 / pixels[:, 6].square().mean().sqrt()[None],
        }
        for name, tensor in found.items():
            buffer = getattr(self, name)
            setattr(self, name, tensor.to(buffer))

    def forward(self) -> tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 3"]]:
        """Rotation of each camera and shift of its centre, along its own axes as given."""
        motion = self.held()
        return rotations(motion[:, :3]), motion[:, 3:]

    def held(self) -> Float[Tensor, "V 6"]:
        """Turn and shift of each camera, without what is the world's; radians and world units."""
        return without_world(self.motion * self.units, self.of_world, self.weights)

    def together(self) -> Float[Tensor, "M 3"]:
        """Orthonormal turns by which all cameras turn alike, each about its own centre; pixels about its own axes."""
        own = self.moved()[..., :3].mT / self.units[:, :3, None]
        return torch.linalg.qr(own.flatten(0, 1))[0]

    def moved(self) -> Float[Tensor, "V 3 4"]:
        """The cameras' poses as they are believed to be."""
        turns, shifts = self()
        axes = self.poses[..., :3]
        return torch.cat([axes @ turns, self.poses[..., 3:] + axes @ shifts[..., None]], -1)


@register("camera", "refined")
class RefinedCamera(Camera):
    """Rotation and position of each training camera, and the lens that all share, refined with the scene.

    Before training, cameras turn until photographs of the sky agree (`panorama`), where there is one, and move until
    the surface is seen in its masks (`capture.outlines`), where there are any. Between training steps each takes a step
    of Gauss-Newton towards its photograph (`gauss_newton`). A motion that all cameras share is taken out, to first
    order: the world stays where the data have put it, with its surface.

    Args:
        start: training steps before the first of these steps, so that the scene is there.
        every: training steps between two of them.
        num_pixels: of each photograph that are looked at in one.
        lens: whether the focal length and the principal point, shared by all views, are refined.
        exposure: whether each training view has a gain of its own, for each colour channel.
        hold_world: whether the motion that all share is taken out; not for cameras in a world that is known.
    """

    moves = True
    lens: Float[Tensor, "3"] | None

    def __init__(
        self,
        start: Natural = 50,
        every: Count = 50,
        num_pixels: Count = 300,
        lens: bool = False,
        exposure: bool = False,
        hold_world: bool = True,
    ) -> None:
        super().__init__(exposure)
        self.start, self.every, self.num_pixels = start, every, num_pixels
        self.motions = _Motions(hold_world)
        self.register_buffer("lens", torch.zeros(3) if lens else None)  # focal length and principal point, pixels

    def begin(self, cameras: Cameras, exposures: Float[Tensor, "V"] | None = None) -> None:
        super().begin(cameras, exposures)
        self.motions.begin(cameras)

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        turns, shifts = self.motions()
        axes = self.motions.poses[view, :, :3]
        local = (rays.directions[:, None] @ axes)[:, 0]
        if self.lens is not None:
            local = self._through_lens(local, view)
        directions = (axes @ (turns[view] @ local[..., None]))[..., 0]
        origins = rays.origins + (axes @ shifts[view, :, None])[..., 0]
        return replace(rays, origins=origins, directions=normalize(directions, dim=-1))

    def slopes(
        self,
        rays: Rays,
        view: Int[Tensor, "R"],
        by_origin: Float[Tensor, "R C 3"],
        by_direction: Float[Tensor, "R C 3"],
    ) -> Float[Tensor, "R C N"]:
        """Derivatives by the motion of each ray's camera in pixels (6), and by the lens (3 more, if it is refined).

        Args:
            rays: of the data's cameras.
            view: of each.
            by_origin: derivatives of anything by the origins of the rays as they are believed to be.
            by_direction: by their directions.
        """
        axes, moved = self.motions.poses[view, :, :3], self(rays, view)
        across = torch.linalg.cross(moved.directions[:, None].expand_as(by_direction), by_direction)
        found = torch.cat([across @ axes, by_origin @ axes], -1) * self.motions.units[view, None]
        if self.lens is None:
            return found
        kept, of_lens = self.lens.clone(), []
        for number in range(len(kept)):  # half a pixel to both sides
            ends = []
            for half in (0.5, -0.5):
                self.lens[number] = kept[number] + half
                ends.append(self(rays, view).directions)
            self.lens.copy_(kept)
            of_lens.append((by_direction * (ends[0] - ends[1])[:, None]).sum(-1))
        return torch.cat([found, torch.stack(of_lens, -1)], -1)

    def numbers(self) -> Float[Tensor, "N"]:
        """Turns and shifts of all cameras along their own axes, then the lens where it is refined; pixels."""
        motion = self.motions.motion.flatten()
        return motion if self.lens is None else torch.cat([motion, self.lens])

    def split(self, numbers: Shaped[Tensor, "N"]) -> tuple[Shaped[Tensor, "V 6"], Shaped[Tensor, "L"]]:
        """The motions of the cameras and the lens, of such numbers."""
        num = self.motions.motion.numel()
        return numbers[:num].view(-1, 6), numbers[num:]

    def position(self) -> tuple[Tensor, Tensor | None]:
        """Where cameras and lens are, for `move_back`."""
        return self.motions.motion.clone(), None if self.lens is None else self.lens.clone()

    def move(self, motion: Float[Tensor, "V 6"], lens: Float[Tensor, "L"]) -> None:
        """Turn and shift cameras, and change the lens that all share, by pixels."""
        self.motions.motion += motion
        if self.lens is not None:
            self.lens += lens

    def move_back(self, position: tuple[Tensor, Tensor | None], worse: Bool[Tensor, "V"], lens: bool) -> None:
        """Put some cameras, and the lens, where they were."""
        self.motions.motion[worse] = position[0][worse]
        if lens and position[1] is not None:
            self.lens = position[1]

    def _through_lens(self, local: Float[Tensor, "R 3"], view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Directions along the cameras' axes, of the same pixels behind the lens as it is believed to be."""
        growth, shift = self._lens()
        ideal = local[:, :2] / -local[:, 2:]
        flipped = ideal * ideal.new_tensor([1.0, -1.0])  # y down, as in the image
        distorted = len(self.motions.distortion) > 0
        if distorted:
            flipped, _ = distort(flipped, self.motions.distortion[view])
        flipped = (flipped - shift / self.motions.focal[view]) / growth
        if distorted:
            flipped, _ = undistort(flipped, self.motions.distortion[view])
        return torch.cat([flipped * ideal.new_tensor([1.0, -1.0]), -torch.ones_like(local[:, 2:])], -1)

    def _lens(self) -> tuple[Float[Tensor, ""], Float[Tensor, "2"]]:
        """Factor of the focal length, and shift of the principal point in pixels."""
        assert self.lens is not None
        return torch.exp(self.lens[0] * self.motions.focal_unit[0]), self.lens[1:]

    @torch.no_grad()
    def believed(self, cameras: Cameras) -> Cameras:
        poses = self.motions.moved().to(cameras.camera_to_world)
        return self._with_lens(replace(cameras, camera_to_world=poses))

    @torch.no_grad()
    def aligned(self, cameras: Cameras) -> Cameras:
        """Other cameras, moved by the similarity of the training cameras, behind the lens that is believed in."""
        old, new, weights = (x.double() for x in (self.motions.poses, self.motions.moved(), self.motions.weights))
        whole = similarity(old, new, weights[:, 0], weights[:, 3])
        poses = whole.moved(cameras.camera_to_world.to(whole.shift)).to(cameras.camera_to_world)
        return self._with_lens(replace(cameras, camera_to_world=poses))

    def _with_lens(self, cameras: Cameras) -> Cameras:
        if self.lens is None:
            return cameras
        growth, shift = (values.to(cameras.fx) for values in self._lens())
        x, y = cameras.cx + shift[0], cameras.cy + shift[1]
        return replace(cameras, fx=cameras.fx * growth, fy=cameras.fy * growth, cx=x, cy=y)

    def learned(self) -> dict[str, float]:
        with torch.no_grad():
            found = {"motion_pixels": float((self.motions.held() / self.motions.units).square().sum(-1).mean().sqrt())}
            if self.lens is not None:
                growth, (x, y) = self._lens()
                found |= {"focal_length_factor": float(growth), "principal_x": float(x), "principal_y": float(y)}
        return super().learned() | found


def rotations(vectors: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3 3"]:
    """Rotations about axes by the vectors' lengths, in radians."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return torch.linalg.matrix_exp(cross.view(-1, 3, 3))
