"""Camera models: estimated poses, lens and exposures of the training views."""
