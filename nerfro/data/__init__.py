"""Data formats: posed images on disk, loaded as cameras, images and masks."""
