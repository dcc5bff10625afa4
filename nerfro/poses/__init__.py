"""Lens and camera poses from photographs: calibration boards, structure from motion, and imported models."""
