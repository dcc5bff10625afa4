"""Image quality: metrics, tables, comparison pictures, and the files that hold them."""
