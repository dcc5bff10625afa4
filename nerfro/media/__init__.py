"""Media: refractive index and its gradient as functions of position."""
