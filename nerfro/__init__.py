"""nerfro: novel-view synthesis of refractive objects."""

__version__ = "0.1.0"
