"""Drinking glasses and bottles: `medium=vessel`, and the fit of its lengths by `nerfro.preprocess vessel=true`.

See docs/guides/vessels.md.
"""

from . import vessel

__all__ = ["vessel"]
