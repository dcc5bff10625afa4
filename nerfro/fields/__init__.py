"""Radiance fields: samples -> density, colour."""
