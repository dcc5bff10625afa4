"""The modules of the plugin that estimates lens and poses of photographs."""

from nerfro.registry.registration import plugin_module

_NAMES = ("boards", "calibration", "collection", "photographs", "structure_from_motion", "video")
_MODULES = [plugin_module(f"camera_calibration.{name}") for name in _NAMES]
boards, calibration, collection, photographs, structure_from_motion, video = _MODULES
Sheet, TagBoard, TagDetections = boards.Sheet, boards.TagBoard, boards.TagDetections
draw_tag, tag_grid, twelve_faces = boards.draw_tag, boards.tag_grid, boards.twelve_faces
numeric_order, require_pycolmap = structure_from_motion.numeric_order, structure_from_motion.require_pycolmap
sequential_pairs = structure_from_motion.sequential_pairs
calibrate, luminance, extract_frames = calibration.calibrate, photographs.luminance, video.extract_frames
