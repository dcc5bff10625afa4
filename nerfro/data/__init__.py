"""Posed images: folder -> cameras, images, masks."""
