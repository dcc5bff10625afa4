"""Compiled kernels, each behind the plain-torch reference that it is tested against."""
