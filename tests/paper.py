"""Classes and functions of the plugin `nerfro/paper/`, which have no importable name before `discover`."""

from importlib import import_module

from nerfro.registry.registration import discover
from nerfro.rendering import Components
from tests.closed_forms import Luneburg

discover()
paper = import_module("nerfro.paper")
eikonal, integrators, mlp = paper.eikonal, paper.integrators, paper.mlp

Eikonal, march_adaptive, march_uniform = eikonal.Eikonal, eikonal.march_adaptive, eikonal.march_uniform
Hierarchical, blur_weights = paper.hierarchical.Hierarchical, paper.hierarchical.blur_weights
Integrator, RayState = integrators.Integrator, integrators.RayState
euler, kick_drift_kick, leapfrog = integrators.euler, integrators.kick_drift_kick, integrators.leapfrog
MipNerfField, MipNerfModel = paper.mip_nerf.MipNerfField, paper.mip_nerf.MipNerfModel
NerfField, Skybox, frustum_gaussians = paper.nerf.NerfField, paper.skybox.Skybox, paper.mip_nerf.frustum_gaussians
RGB_PADDING, RadianceMLP, SkipMLP, padded_sigmoid = mlp.RGB_PADDING, mlp.RadianceMLP, mlp.SkipMLP, mlp.padded_sigmoid
Linear, positional_encoding = paper.linear.Linear, paper.encoding.positional_encoding
integrated_positional_encoding = paper.encoding.integrated_positional_encoding
Smoothness, tile_roughness = paper.smoothness.Smoothness, paper.smoothness.tile_roughness
VoxelGrid, gradient = paper.voxel_grid.VoxelGrid, paper.voxel_grid.gradient


def small_components() -> Components:
    """Small components of the paper's model, around a Luneburg lens."""
    return Components(
        medium=Luneburg(),
        path_sampler=Eikonal("euler", 64),
        point_sampler=Hierarchical(8, 8),
        make_field=lambda: NerfField(width=16, depth=2, skip=1, view_width=8),
        boundary=Skybox(width=8),
    )
