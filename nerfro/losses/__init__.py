"""Training losses: renderings, batch, model -> scalar."""
