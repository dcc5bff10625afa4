"""From masks to surfaces: outlines, visual hull, smooth fits and bodies of revolution."""
