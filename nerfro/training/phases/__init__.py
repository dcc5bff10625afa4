"""Phases of a training: steps before the first training step, and between training steps."""
