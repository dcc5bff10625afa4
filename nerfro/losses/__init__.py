"""Training losses: scalar functions of renderings, batch and scene."""
