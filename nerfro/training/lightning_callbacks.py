"""Callbacks of Lightning that a configuration may choose by name, as in `+callbacks=learning_rate_monitor`.

Callbacks that conflict with those of every run (checkpoints, progress, time limit), or that need epochs, are left out.
"""

from __future__ import annotations

from lightning.pytorch import callbacks

from nerfro.registry.registration import add

for _name, _cls in {
    "device_stats_monitor": callbacks.DeviceStatsMonitor,
    "early_stopping": callbacks.EarlyStopping,
    "learning_rate_monitor": callbacks.LearningRateMonitor,
}.items():
    add("callbacks", _name, _cls)
