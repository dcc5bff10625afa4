"""Comparison of many runs: tables over methods and scenes, and an HTML report."""
