"""Procedural scenes; see docs/guides/synthetic_scenes.md."""
