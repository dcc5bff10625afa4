"""Trained scenes to look at and to hand on: pictures, films, pages and files for other programs."""
