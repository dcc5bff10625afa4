"""Numbers that the compiled kernels share with their reference implementations."""

# Squared fraction of |v| below which the component of v along a kick is not corrected (`integrators.leapfrog`).
MIN_NORMAL_PART = 0.01
# Largest relative difference of |v|^2 and n^2 after a step that resolves the index (`integrators.leapfrog`).
RESOLVED = 1e-4

# Squared change of a unit direction (1e-7 radians) below which a path counts as straight.
MIN_TURN = 1e-14
# Fraction of a step within which the point where the index begins to vary counts as reached.
REACHED = 1e-3
