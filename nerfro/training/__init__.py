"""What happens around a model while it trains: batches, callbacks, logs, and the run's folder."""
