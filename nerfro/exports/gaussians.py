"""3-D Gaussians with view-dependent colour: projection into images, and the files of other programs."""

from __future__ import annotations

import gzip
import math
import struct
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.cameras import Cameras
from nerfro.fields.spherical_harmonics import spherical_harmonics
from nerfro.kernels.rasterizer import rasterize

HARMONIC_0 = 0.28209479177387814  # value of the first basis function
_SIGNS = (1.0, -1.0, 1.0, -1.0)  # with the Condon-Shortley phase, as in files of Gaussians
_BLUR = 0.3  # variance of the low-pass filter of the paper's implementation, pixels squared
_MIN_DEPTH = 0.1  # depth below which Gaussians are left out, relative to where the rays of a camera begin
_MAX_TANGENT = 1.3  # of rays for the linear projection, relative to that of the edge of the image


class Gaussians(NamedTuple):
    """N Gaussians as they are stored in files; world units.

    Attributes:
        positions: means.
        log_scales: logarithms of the standard deviations along the axes of each Gaussian.
        rotations: quaternions (w, x, y, z) of the axes, of any length.
        logits: logits of the opacities.
        harmonics: coefficients of spherical harmonics of the degrees 0 and 1; with 0.5 added, their sum is the sRGB
            colour in the direction from the camera to the Gaussian.
    """

    positions: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    rotations: Float[Tensor, "N 4"]
    logits: Float[Tensor, "N"]
    harmonics: Float[Tensor, "N 4 3"]

    def render(self, cameras: Cameras, view: int) -> Float[Tensor, "H W 3"]:
        """Render an sRGB image of a pinhole camera, differentiable with respect to the Gaussians.

        Each Gaussian is projected with covariance J W S W^T J^T (Zwicker et al., "EWA Splatting", 2002; Kerbl et al.,
        "3D Gaussian Splatting", SIGGRAPH 2023, Eqn. 5), where J is the derivative of the perspective projection.
        """
        pose = cameras.camera_to_world[view]
        axes = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])  # right, down and forward
        focal = torch.stack([cameras.fx[view], cameras.fy[view]])
        middle = torch.stack([cameras.cx[view], cameras.cy[view]])
        size = focal.new_tensor([cameras.width, cameras.height])
        limit = _MAX_TANGENT * torch.maximum(middle, size - middle) / focal
        with torch.no_grad():
            local = (self.positions - pose[:, 3]) @ axes
            z = local[:, 2]
            reach = limit * z[:, None] + 3 * self.log_scales.amax(-1, keepdim=True).exp()
            seen = (local[:, :2].abs() < reach).all(-1) & (
                z > (1e-9 * z.abs().amax()).clamp(min=_MIN_DEPTH * cameras.near)
            )
            rows = seen.nonzero()[:, 0]
            rows = rows[z[rows].argsort()]
        positions, log_scales, rotations, logits, harmonics = (values[rows] for values in self)
        offsets = positions - pose[:, 3]
        local = offsets @ axes
        z, ratio = local[:, 2:], local[:, :2] / local[:, 2:]
        bounded = ratio.maximum(-limit).minimum(limit)
        turned = axes.T @ rotation_matrices(rotations) * log_scales.exp()[:, None]
        # Rows of J W R S, whose product with its transpose is the covariance.
        edges = (focal / z)[..., None] * (turned[:, :2] - bounded[..., None] * turned[:, 2:])
        xx, yy = (edges.square().sum(-1) + _BLUR).unbind(-1)
        xy = (edges[:, 0] * edges[:, 1]).sum(-1)
        inverse = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy.square())[:, None]
        basis = spherical_harmonics(functional.normalize(offsets, dim=-1), 2) * z.new_tensor(_SIGNS)
        colours = (0.5 + (basis[..., None] * harmonics).sum(1)).clamp(min=0)
        splats = torch.cat([focal * ratio + middle, inverse, logits.sigmoid()[:, None], colours], -1)
        return rasterize(splats, cameras.height, cameras.width)

    def to_ply(self) -> bytes:
        """Encode as .ply in the layout of the paper's implementation; coefficients of degree 1 by colour channel."""
        rest = self.harmonics[:, 1:].transpose(1, 2).flatten(1)
        rotations = functional.normalize(self.rotations, dim=-1)
        columns = [self.positions, self.harmonics[:, 0], rest, self.logits[:, None], self.log_scales, rotations]
        names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9)), "opacity"]
        names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self.positions)}"]
        header += [*(f"property float {name}" for name in names), "end_header\n"]
        return "\n".join(header).encode() + torch.cat(columns, -1).numpy().astype("<f4").tobytes()

    def to_spz(self) -> bytes:
        """Encode as .spz of version 2: gzip, at most 28 bytes for each Gaussian, the coordinates of `to_ply`.

        Positions have 24 bits, and other values 8 (Niantic, github.com/nianticlabs/spz, README and `load-spz.cc`).
        """
        fraction_bits = math.floor(math.log2((2**23 - 1) / max(1.0, float(self.positions.abs().max()))))
        fixed = (self.positions.double() * 2**fraction_bits).round().numpy().astype("<i4")
        rotations = functional.normalize(self.rotations, dim=-1)
        rest = (self.harmonics[:, 1:].flatten(1) * 128).round() + 128
        columns = [
            self.logits.sigmoid() * 255,
            (self.harmonics[:, 0] * 0.15 + 0.5) * 255,
            (self.log_scales + 10) * 16,
            (rotations[:, 1:] * torch.where(rotations[:, :1] < 0, -1, 1) + 1) * 127.5,
            ((rest + 4) / 8).floor() * 8,
        ]
        packed = [column.round().clamp(0, 255).to(torch.uint8).numpy().tobytes() for column in columns]
        header = struct.pack("<4sIIBBBB", b"NGSP", 2, len(fixed), 1, fraction_bits, 0, 0)
        positions = fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
        return gzip.compress(b"".join([header, positions, *packed]), mtime=0)


def rotation_matrices(quaternions: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Return the rotations of quaternions (w, x, y, z) of any length."""
    w, x, y, z = functional.normalize(quaternions, dim=-1).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, -1).view(-1, 3, 3)
