"""Functions and classes of `nerfro/synthetic/`, for imports by tests."""

from importlib import import_module

from nerfro.registry.registration import discover

discover()
dataset, glass, llvm, path_tracer, scene, surface, synthesis, viewpoints = (
    import_module(f"nerfro.synthetic.{name}")
    for name in ("dataset", "glass", "llvm", "path_tracer", "scene", "surface", "synthesis", "viewpoints")
)
CAMERA_ANGLE_X, CAMERA_DISTANCE = dataset.CAMERA_ANGLE_X, dataset.CAMERA_DISTANCE
PathTracer, Pinhole, load_mitsuba = path_tracer.PathTracer, path_tracer.Pinhole, path_tracer.load_mitsuba
SyntheticScene, lat_long_texture, find_scene = scene.SyntheticScene, scene.lat_long_texture, synthesis.find_scene
SurfaceMesh, rounded_box = surface.SurfaceMesh, surface.rounded_box
sphere, torus_angles = surface.sphere, surface.torus_angles
directions_on_sphere, look_at_origin = viewpoints.directions_on_sphere, viewpoints.look_at_origin
