"""Classes and functions of the plugin `plugins/paper/`, which have no importable name before `discover`."""

from importlib import import_module

from nerfro.registry import discover

discover()
eikonal, hierarchical, integrators, mip_nerf, nerf, radiance_mlp, voxel_grid = (
    import_module(f"nerfro_plugins.paper.{name}")
    for name in ("eikonal", "hierarchical", "integrators", "mip_nerf", "nerf", "radiance_mlp", "voxel_grid")
)
Eikonal, march_adaptive, march_uniform = eikonal.Eikonal, eikonal.march_adaptive, eikonal.march_uniform
Hierarchical, blur_weights = hierarchical.Hierarchical, hierarchical.blur_weights
Integrator, RayState = integrators.Integrator, integrators.RayState
euler, kick_drift_kick, leapfrog = integrators.euler, integrators.kick_drift_kick, integrators.leapfrog
MipNerfField, MipNerfModel, frustum_gaussians = mip_nerf.MipNerfField, mip_nerf.MipNerfModel, mip_nerf.frustum_gaussians
integrated_positional_encoding = mip_nerf.integrated_positional_encoding
NerfField, RadianceMLP = nerf.NerfField, radiance_mlp.RadianceMLP
VoxelGrid, gradient = voxel_grid.VoxelGrid, voxel_grid.gradient
