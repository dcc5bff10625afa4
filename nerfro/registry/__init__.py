"""The registry of plugins, and the ranges of their settings."""
