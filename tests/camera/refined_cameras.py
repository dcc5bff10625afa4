"""The modules of the plugin that refines cameras."""

from importlib import import_module

from nerfro.registry.registration import discover

discover()
_NAMES = ("gauss_newton", "least_squares", "outlines", "panorama", "phase", "pixel_units", "refined")
_MODULES = [import_module(f"nerfro.camera.refined.{name}") for name in _NAMES]
gauss_newton, least_squares, outlines, panorama, phase, pixel_units, refined = _MODULES
PriorInformation, RefinedCamera = least_squares.PriorInformation, refined.RefinedCamera
align, align_to_outlines = panorama.align, outlines.align_to_outlines
