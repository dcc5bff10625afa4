"""`python -m tests.fuzz.campaign cases=3000 seed=0`: draw broken inputs of every kind, and report what does not hold.

Every case is a function of seed and number. `only=KIND` draws cases of one kind, `first=N` begins with case N.
"""

import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.conftest import tiny_default_options, write_tiny_scene
from tests.fuzz.cases import KINDS
from tests.fuzz.world import World

# Share of the cases: readers in this process take milliseconds, commands a second.
_WEIGHTS = {"data_formats": 16, "single_files": 16, "checkpoints": 4, "run_folders": 2}


def run_case(world: World, kind: str, seed: int, number: int) -> str | None:
    """Run one case, and return what does not hold."""
    try:
        return KINDS[kind](world, random.Random(f"{kind} {seed} {number}"))
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        world.clean()


def main() -> None:
    """Run the cases, print each finding and the counts; exits with status 1 if there is a finding."""
    options = {"cases": "3000", "seed": "0", "first": "0", "only": ""}
    options |= dict(argument.split("=", 1) for argument in sys.argv[1:])
    seed, first = int(options["seed"]), int(options["first"])
    kinds = [options["only"]] if options["only"] else list(KINDS)
    weights = [_WEIGHTS.get(kind, 1) for kind in kinds]
    counts, findings, begun = Counter[str](), Counter[str](), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="campaign_") as folder:
        scene = write_tiny_scene(Path(folder, "scene"))
        (root := Path(folder, "world")).mkdir()
        world = World(root, scene, tiny_default_options(scene))
        for number in range(first, first + int(options["cases"])):
            (kind,) = random.Random(f"kind {seed} {number}").choices(kinds, weights)
            counts[kind] += 1
            found = run_case(world, kind, seed, number)
            if found is not None:
                findings[kind] += 1
                print(f"case {number}, {kind}: {found}", flush=True)
            if (number + 1) % 250 == 0:
                print(f"{number + 1 - first} cases in {time.monotonic() - begun:.0f} s, {findings.total()} findings")
                sys.stdout.flush()
    for kind in kinds:
        print(f"{counts[kind]:6} {kind}, {findings[kind]} findings")
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    main()
