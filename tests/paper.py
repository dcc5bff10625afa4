"""Classes and functions of the plugin `plugins/paper/`, which have no importable name before `discover`."""

from importlib import import_module

from nerfro.registry import discover

discover()
paper = import_module("nerfro_plugins.paper")
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
