"""Training of models: configuration, batches, Lightning, run folders and sweeps."""
