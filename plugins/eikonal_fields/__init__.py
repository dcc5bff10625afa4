"""Eikonal Fields (Bemana et al., "Eikonal Fields for Refractive Novel-View Synthesis", SIGGRAPH 2022) as a plugin.

A whole method of somebody else, made of registered parts: `medium=index_field`, `sampler/path=box_march` and
`model=eikonal_fields`; everything else is nerfro's. Use it with `+experiment=eikonal_fields`. What follows the authors'
code, https://github.com/m-bemana/eikonalfield, and what does not, is told in docs/guides/plugins.md.
"""

from . import box_march, index_field, model

__all__ = ["box_march", "index_field", "model"]
