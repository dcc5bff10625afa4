"""The paper's mode: "Sampling Neural Radiance Fields for Refractive Objects" (Pan et al., SIGGRAPH Asia 2022).

The settings `+experiment=paper_*` and the baselines `nerf` and `mipnerf` use these registered components:

- `medium=voxel_grid`: the object as a smoothed grid of refractive index.
- `sampler/path=eikonal`: paths by the Eikonal equation; `integrator=euler` is the method of the paper.
- `sampler/points=hierarchical`: coarse and fine samples.
- `field=nerf`, and `field=mip_nerf` with `model=mip_nerf`: the networks of NeRF and mip-NeRF.
- `background=skybox`: the network of the background.
- `loss=smoothness`: the loss on the background colour.

Other losses and rendering are components of nerfro.
"""
