"""Train with a limit of processor time, so that results do not depend on other work on the machine.

    python benchmarks/processor_time.py +experiment=straight data.root=DIR trainer.max_time=00:00:05:00

The arguments are those of `python -m nerfro.train`. PyTorch and Numba use one thread, unless `OMP_NUM_THREADS` and
`NUMBA_NUM_THREADS` say otherwise. Processor time is that of all threads of the process.
"""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

if __name__ == "__main__":
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

    # Torch and Numba read the variables when they are imported.
    from lightning.pytorch.callbacks import timer

    from nerfro.train import main

    timer.time = SimpleNamespace(monotonic=time.process_time)
    main()
