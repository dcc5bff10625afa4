"""Atomic writing, locks, caches, and readers and writers of file formats."""
