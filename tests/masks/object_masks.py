"""The modules of the plugin that makes masks."""

from nerfro.registry.registration import plugin_module

_NAMES = ("mask_files", "masking", "tracking")
mask_files, masking, tracking = (plugin_module(f"object_masks.{name}") for name in _NAMES)
read_outlines, save_mask = mask_files.read_outlines, mask_files.save_mask
polygon_mask, propagate = masking.polygon_mask, masking.propagate
load_tracker, track_object = tracking.load_tracker, tracking.track_object
