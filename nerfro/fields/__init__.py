"""Radiance fields: density and radiance of samples."""
