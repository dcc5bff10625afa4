"""The modules of the plugin that estimates lens and poses of photographs."""

from nerfro.registry import plugin_module

_NAMES = ("boards", "calibration", "collection", "photographs", "reconstruction", "video")
_MODULES = [plugin_module(f"camera_calibration.{name}") for name in _NAMES]
boards, calibration, collection, photographs, reconstruction, video = _MODULES
Sheet, Sighting, TagBoard = boards.Sheet, boards.Sighting, boards.TagBoard
draw_tag, tag_grid, twelve_faces = boards.draw_tag, boards.tag_grid, boards.twelve_faces
numeric_order, require_pycolmap = reconstruction.numeric_order, reconstruction.require_pycolmap
sequential_pairs = reconstruction.sequential_pairs
calibrate, luminance, extract_frames = calibration.calibrate, photographs.luminance, video.extract_frames
