"""Eikonal Fields (Bemana et al., "Eikonal Fields for Refractive Novel-View Synthesis", SIGGRAPH 2022) as a plugin.

The method consists of the registered components `medium=index_field`, `sampler/path=box_march` and
`model=eikonal_fields`, and of components of nerfro. Use it with `+experiment=eikonal_fields`. The page
docs/lab/eikonal_fields.md compares the settings with the authors' code, https://github.com/m-bemana/eikonalfield.
"""

from . import box_march, index_field, model

__all__ = ["box_march", "index_field", "model"]
