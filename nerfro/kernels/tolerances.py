"""Numbers that compiled kernels share with their reference implementations."""

# Number of steps of a ray that crosses the shell of a solid along the normal.
STEPS_PER_SHELL = 8
# Steps of slanting rays grow with 1 / cosine of the angle to the normal, down to this cosine.
MIN_COSINE = 0.25
# Distances that are interpolated on a grid can exceed true distances by a few percent; a jump must not skip a shell.
SAFE_SHARE = 0.9

# Smallest step of the search for a surface, as a fraction of the box's shortest side; thinner sheets are missed.
MIN_SEARCH_STEP = 2e-4
# Distance beyond the box at which a bent path ends that is longer than far, as a fraction of the box's shortest side.
BEYOND_BOX = 1e-3
