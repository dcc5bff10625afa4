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
from torch import Tensor

from nerfro.files.images import save_png
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from tests.ball_photographs import mesh, photographs, save, soft_masks

TRAIN = (
    "evaluation.split=train evaluation.every=0 evaluation.subdivision.side=1 logger=none trainer.accelerator=cpu "
    "trainer.max_steps=30 trainer.max_time=null batches.size=64 boundary.resolutions=[4,8] field.num_levels=2 "
    "field.log2_table_size=8 sampler.points.num_samples=4 sampler.points.resolution=16 phase.background.steps=50"
)
OPTIONS = ["data=blender", "data.near=0.5", "medium.resolution=32", "preprocess=resolution=24", "trial_steps=5"]


def write_photographs(data: Path) -> None:
    """Write photographs and masks of a glass ball."""
    save(photographs([1.45]), data)
    for view, mask in enumerate(soft_masks(mesh())):
        save_png(data / "masks" / "train" / f"r_{view}.png", mask[..., None].expand(-1, -1, 3))


def reconstruct(data: Path, out: Path, seconds: float | None = None) -> float:
    """Run the command, kill it with all its stages after some seconds, and return its time."""
    command = [sys.executable, "-m", "nerfro.reconstruct", *OPTIONS, f"data.root={data}", f"out={out}"]
    begun = time.monotonic()
    process = subprocess.Popen([*command, f"train={TRAIN}"], stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        status = process.wait(seconds)
        assert status == 0, f"{out} ends with status {status}"
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return time.monotonic() - begun


def weights(out: Path) -> dict[str, Tensor]:
    return load_checkpoint(out / "run" / LAST_CHECKPOINT)[0]["state_dict"]


def main() -> None:
    """Compare killed and repeated reconstructions with an undisturbed one."""
    root, num_kills = Path(sys.argv[1]), int(sys.argv[2])
    write_photographs(root / "ball")
    reconstruct(root / "ball", root / "compiles")
    seconds = reconstruct(root / "ball", root / "right")
    expected, draw = weights(root / "right"), random.Random(0)
    for number in range(num_kills):
        out = root / str(number)
        spent = reconstruct(root / "ball", out, draw.uniform(0.03, 0.97) * seconds)
        there = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
        reconstruct(root / "ball", out)
        found = weights(out)
        assert all(torch.equal(expected[name], found[name]) for name in expected), f"weights differ after kill {number}"
        assert (out / "page.html").is_file()
        print(
            f"{number}: killed after {spent:.1f} of {seconds:.1f} s with {', '.join(there)}; equal weights", flush=True
        )


if __name__ == "__main__":
    main()
