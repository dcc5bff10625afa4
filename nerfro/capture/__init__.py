"""Reconstruction of lens, poses, masks, surface and refractive index from photographs."""
