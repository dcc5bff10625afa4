"""Train with a time limit of processor time, so that a run on a busy machine is worth one on a quiet core.

    python benchmarks/processor_time.py +experiment=straight data.root=DIR trainer.max_time=00:00:05:00

takes what `python -m nerfro.train` takes. On a quiet core, and with one thread, both are the same.
"""

from __future__ import annotations

import time
from types import SimpleNamespace

from lightning.pytorch.callbacks import timer

from nerfro.train import main

if __name__ == "__main__":
    timer.time = SimpleNamespace(monotonic=time.process_time)
    main()
