"""Train with a limit of processor time, so that results do not depend on other work on the machine.

    python benchmarks/processor_time.py +experiment=straight data.root=DIR trainer.max_time=00:00:05:00

The arguments are those of `python -m nerfro.train`. Processor time is that of all threads of the process. With one
thread on an idle core, both limits are the same.
"""

from __future__ import annotations

import time
from types import SimpleNamespace

from lightning.pytorch.callbacks import timer

from nerfro.train import main

if __name__ == "__main__":
    timer.time = SimpleNamespace(monotonic=time.process_time)
    main()
