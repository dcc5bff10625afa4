"""Rendering of synthetic scenes with Mitsuba 3: `python -m nerfro.synthesize`; `scenes/` holds the scenes.

See docs/guides/synthetic_scenes.md.
"""
