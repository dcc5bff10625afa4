"""LightningModules: rays -> renderings -> loss."""
