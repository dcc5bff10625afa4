"""The scene, and the renderer from rays to radiance: trace, sample, query, composite."""

from nerfro.rendering.ray_tracer import RayTracer
from nerfro.rendering.renderer import Components, RenderedRays, Renderer
from nerfro.rendering.scene import Scene

__all__ = ["Components", "RayTracer", "RenderedRays", "Renderer", "Scene"]
