"""Image quality: metrics, score tables, comparison images, and their files."""
