"""From photographs to posed views: calibration targets, poses, masks."""
