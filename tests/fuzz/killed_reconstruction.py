"""`python -m tests.fuzz.killed_reconstruction FOLDER KILLS`: kill `nerfro.reconstruct` at random times, and repeat it.

A repeated reconstruction must end with the weights of an undisturbed one, bit for bit.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from tests.ball_photographs import RECONSTRUCTION, RECONSTRUCTION_TRAINING, save_with_masks
from tests.conftest import weights_of

TRAIN = " ".join([*RECONSTRUCTION_TRAINING, "trainer.max_steps=30", "phase.background.steps=50"])


def reconstruct(data: Path, out: Path, seconds: float | None = None) -> float:
    """Run the command, kill it with all its stages after some seconds, and return its time."""
    command = [sys.executable, "-m", "nerfro.reconstruct", *RECONSTRUCTION, f"data.root={data}", f"out={out}"]
    begun = time.monotonic()
    process = subprocess.Popen(
        [*command, "trial_steps=5", f"train={TRAIN}"], stdout=subprocess.DEVNULL, start_new_session=True
    )
    try:
        status = process.wait(seconds)
        assert status == 0, f"{out} ends with status {status}"
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return time.monotonic() - begun


def main() -> None:
    """Compare killed and repeated reconstructions with an undisturbed one."""
    root, num_kills = Path(sys.argv[1]), int(sys.argv[2])
    save_with_masks(root / "ball")
    reconstruct(root / "ball", root / "compiles")
    seconds = reconstruct(root / "ball", root / "right")
    expected, draw = weights_of(root / "right" / "run"), random.Random(0)
    for number in range(num_kills):
        out = root / str(number)
        spent = reconstruct(root / "ball", out, draw.uniform(0.03, 0.97) * seconds)
        there = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
        reconstruct(root / "ball", out)
        found = weights_of(out / "run")
        assert all(torch.equal(expected[name], found[name]) for name in expected), f"weights differ after kill {number}"
        assert (out / "page.html").is_file()
        print(
            f"{number}: killed after {spent:.1f} of {seconds:.1f} s with {', '.join(there)}; equal weights", flush=True
        )


if __name__ == "__main__":
    main()
