"""Hydra's sweeper for nerfro.train: skips cells that are finished, and lets no failing cell stop the others.

Hydra takes sweepers from the namespace package `hydra_plugins` alone and imports this module in every program that uses
Hydra, so nothing of nerfro is imported before a sweep begins. It also runs the module before it is known by its name,
which dataclasses with postponed annotations do not survive.
"""

import inspect
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

if TYPE_CHECKING:
    from nerfro.training.sweeps import Cell


@dataclass
class CellSweeperConfig:
    """Fields of `hydra.sweeper`.

    Attributes:
        params: what to sweep over, `override key: values`; the command line goes before them.
        retry_failed: whether cells that failed in an earlier start of the sweep are run again.
        scenes: folder of the rendered scenes, for `params`.
    """

    _target_: str = "hydra_plugins.nerfro_cells.CellSweeper"
    params: Optional[dict[str, str]] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    retry_failed: bool = False
    scenes: str = "outputs/scenes"


ConfigStore.instance().store(group="hydra/sweeper", name="nerfro_cells", node=CellSweeperConfig, provider="nerfro")


class CellSweeper(BasicSweeper):
    """The product of all values that are swept over, as Hydra's own sweeper makes it, but one that can be continued.

    Args:
        params, retry_failed, scenes: see `CellSweeperConfig`.
    """

    def __init__(
        self,
        params: Optional[dict[str, str]],  # noqa: UP045
        retry_failed: bool,
        scenes: str,
    ) -> None:
        super().__init__(max_batch_size=None, params=params)
        self._retry_failed = retry_failed

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from nerfro.training.sweeps import CellTask

        task = CellTask(inspect.unwrap(task_function))
        super().setup(hydra_context=hydra_context, task_function=task, config=config)

    def sweep(self, arguments: list[str]) -> None:
        """Run all cells that are not finished; exits with status 1 if any is missing at the end.

        Raises:
            NerfroError: two cells would share a folder.
        """
        from nerfro.training.sweeps import State

        assert self.config is not None
        assert self.launcher is not None
        cells = self._cells(arguments)
        before = [cell.state() for cell in cells]
        wanted = {State.OPEN, State.FAILED} if self._retry_failed else {State.OPEN}
        to_run = [cell for cell, (state, _) in zip(cells, before, strict=True) if state in wanted]
        folder = self.config.hydra.sweep.dir
        print(f"nerfro: sweep {folder}: {len(cells)} cells, {len(to_run)} to run", flush=True)
        for cell, (state, reason) in zip(cells, before, strict=True):
            if state not in (State.OPEN, State.FINISHED):
                print(f"  {cell.folder.name}: {state.value}{reason and f': {reason}'}", flush=True)
        if to_run:
            self._launch(to_run)

        ends = [cell.state() for cell in cells]
        missing = [(cell, end) for cell, end in zip(cells, ends, strict=True) if end[0] is not State.FINISHED]
        print(f"nerfro: sweep {folder}: {len(cells) - len(missing)} of {len(cells)} cells finished")
        for cell, (state, reason) in missing:
            print(f"  {cell.folder.name}: {state.value}{reason and f': {reason}'}")
        if len(missing) < len(cells):
            print(f"The table: python -m nerfro.summary 'runs={folder}'")
        if missing:
            failed = any(state is State.FAILED for _, (state, _) in missing)
            print(
                "To go on, repeat the command"
                + ("; failed cells want hydra.sweeper.retry_failed=true" if failed else "")
            )
            sys.exit(1)

    def _cells(self, arguments: list[str]) -> "list[Cell]":
        from nerfro.cli import renamed_override
        from nerfro.errors import NerfroError

        assert self.hydra_context is not None
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = [*map(renamed_override, self._parse_config()), *arguments]
        (jobs,) = self.split_arguments(parser.parse_overrides(overrides), None)
        if not jobs:
            raise NerfroError("the sweep has no cells: a glob or range in it names nothing")
        # What is swept over in a file tells cells apart even where the command line leaves one value of it.
        told_apart = [
            i
            for i, override in enumerate(jobs[0])
            if override.split("=", 1)[0] in self.params or len({job[i] for job in jobs}) > 1
        ]
        cells = [self._cell(number, job, [job[i] for i in told_apart]) for number, job in enumerate(jobs)]
        folders: "dict[Path, Cell]" = {}
        for cell in cells:
            if cell.folder in folders:
                both = " and ".join(" ".join(c.overrides[:-1]) for c in (folders[cell.folder], cell))
                raise NerfroError(f"two cells would share the folder {cell.folder.name}: {both}; give them other names")
            folders[cell.folder] = cell
        return cells

    def _cell(self, number: int, overrides: Sequence[str], swept: Sequence[str]) -> "Cell":
        from nerfro.training.sweeps import Cell, Identity, folder_name, refusal

        assert self.config is not None
        assert self.hydra_context is not None
        config: Any = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.num = config.hydra.job.id = number
            HydraConfig.instance().set_config(config)
            folder = Path(config.hydra.sweep.dir)
            del config["hydra"]
        name = folder_name(config, swept)
        refused = refusal(config)
        identity = None if refused else Identity.of(config)
        return Cell([*overrides, f"hydra.sweep.subdir='{name}'"], folder / name, identity, refused)

    def _launch(self, cells: "Sequence[Cell]") -> None:
        from nerfro.cli import in_one_line

        assert self.launcher is not None
        try:
            self.launcher.launch([cell.overrides for cell in cells], initial_job_idx=0)
        except (KeyboardInterrupt, SystemExit):
            print("nerfro: the sweep was interrupted; the same command goes on with it", file=sys.stderr, flush=True)
            raise
        except Exception as error:  # a worker died, or the launcher could not start any: the cells tell what is done
            print(f"nerfro: the launcher gave up: {in_one_line(error)}", file=sys.stderr, flush=True)
