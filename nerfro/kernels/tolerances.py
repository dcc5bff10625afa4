"""Numbers that the plain and the compiled code share."""

# Squared share of |v| below which v's component along a kick is not corrected (see samplers.integrators.leapfrog).
MIN_NORMAL_PART = 0.01
# Share of n^2 by which |v|^2 may differ from it after a step that resolves the index (see there too).
RESOLVED = 1e-4

# A ray that crosses the shell of a solid along its normal takes this many steps in it.
STEPS_PER_SHELL = 8
# Steps of slanting rays grow with 1 / cosine of their angle to the normal, up to here, where the shell turns them.
MIN_COSINE = 0.25
# Distances interpolated on a grid may exceed the true ones by a few percent; jumps must not leap over a shell.
SAFE_SHARE = 0.9

# Squared change of a unit direction (1e-7 radians) below which a path counts as straight.
MIN_TURN = 1e-14
# Within this share of a step the place where the index begins to vary counts as reached.
REACHED = 1e-3

# The search for a surface takes steps of at least this share of the box's shortest side: thinner sheets are overlooked.
MIN_SEARCH_STEP = 2e-4
# A bent path that is longer than far ends this share of the box's shortest side beyond the box.
BEYOND_BOX = 1e-3
