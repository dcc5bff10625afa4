"""Optimizers and schedulers of PyTorch by name, for groups of parameters."""
