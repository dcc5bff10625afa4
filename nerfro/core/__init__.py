"""Values and functions that all rooms share."""
