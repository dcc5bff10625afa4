"""What lies beyond the volume: exit direction -> colour."""
