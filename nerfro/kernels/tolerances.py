"""Numbers that compiled kernels share with their reference implementations."""

# Squared fraction of |v| below which the component of v along a kick is not corrected
# (samplers.paths.integrators.leapfrog).
MIN_NORMAL_PART = 0.01
# Largest relative difference of |v|^2 and n^2 after a step that resolves the index
# (samplers.paths.integrators.leapfrog).
RESOLVED = 1e-4

# Number of steps of a ray that crosses the shell of a solid along the normal.
STEPS_PER_SHELL = 8
# Steps of slanting rays grow with 1 / cosine of the angle to the normal, down to this cosine.
MIN_COSINE = 0.25
# Distances that are interpolated on a grid can exceed true distances by a few percent; a jump must not skip a shell.
SAFE_SHARE = 0.9

# Squared change of a unit direction (1e-7 radians) below which a path counts as straight.
MIN_TURN = 1e-14
# Fraction of a step within which the point where the index begins to vary counts as reached.
REACHED = 1e-3

# Smallest step of the search for a surface, as a fraction of the box's shortest side; thinner sheets are missed.
MIN_SEARCH_STEP = 2e-4
# Distance beyond the box at which a bent path ends that is longer than far, as a fraction of the box's shortest side.
BEYOND_BOX = 1e-3
