"""Models: renderers with radiance fields, from rays to renderings."""
