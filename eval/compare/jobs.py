"""Cells of a comparison, a world and a seed each: done by several processes or machines, each kept in a file."""

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from eval.compare import run as compare_cell
from eval.compare.settings import LiveSettings, Settings
from eval.worlds.foraging import HOMES
from eval.worlds.suite import TASKS
from neuroprior._files import versions, write_json, write_whole
from neuroprior._threads import one_thread
from neuroprior.report.processes import do_each, progress_bar

if TYPE_CHECKING:
    from lightning import Fabric

DRAWN_BY = ("gymnasium", "minigrid")
"""Packages whose other versions may make other worlds."""

LONGEST_WAIT = timedelta(days=365)
"""How long a process that torchrun started waits for the others to finish their cells."""


WORLDS: dict[str, Any] = {**TASKS, **HOMES}
"""All that cells are of, by name."""


class Cell(NamedTuple):
    """A world, and the number of a seed."""

    world: str
    seed: int

    @property
    def file(self) -> str:
        """The name of its file, by what the world is, too: another world of that name has other cells."""
        return f"{self.world}-{self.seed}-{compare_cell.digest(WORLDS[self.world])}.json"


@dataclass(frozen=True)
class Study:
    """What is done in each cell, and the folder in which finished cells are kept.

    Attributes:
        folder: of the cells; another for other settings.
        settings: of every cell.
        run: does a cell: `(world, seed, settings)` gives JSON values, where the world is one of `WORLDS`.
    """

    folder: Path
    settings: Settings | LiveSettings
    run: Callable[[Any, int, Any], dict[str, Any]]

    @classmethod
    def prepare(
        cls,
        out: Path,
        settings: Settings | LiveSettings,
        run: Callable[[Any, int, Any], dict[str, Any]],
        recipe: str = "",
    ) -> "Study":
        """Find the folder of these settings, and of no others, in `out`; make it where there is none yet.

        Args:
            out: the folder of the report.
            settings, run: see `Study`.
            recipe: what else decides a cell; that of `compare_cell` by default.

        Raises:
            OSError: a folder of a saved prior cannot be read, or `out` not be written.
        """
        # Other versions and recipes give other results: cells that were finished with them do not count.
        decides = {"settings": asdict(settings), "recipe": recipe or compare_cell.recipe(), "what": run.__qualname__}
        decides |= versions(*DRAWN_BY)
        digest = hashlib.sha256(json.dumps(decides, sort_keys=True).encode())
        for prior in settings.priors if isinstance(settings, Settings) else ():
            for name in ("config.json", "model.safetensors"):
                digest.update((Path(prior) / name).read_bytes())
        folder = out / "cells" / digest.hexdigest()[:12]
        folder.mkdir(parents=True, exist_ok=True)
        return cls(folder, settings, run)

    def finished(self, cell: Cell) -> bool:
        """Whether its results are there."""
        return (self.folder / cell.file).exists()

    def read(self, cell: Cell) -> dict[str, Any]:
        """The results of a finished cell.

        Raises:
            ValueError: the file is damaged.
            OSError: it is not there.
        """
        path = self.folder / cell.file
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: damaged; without this file the same command does the cell again") from error
        assert isinstance(found, dict)
        return found


def cells_of(worlds: Sequence[str], seeds: int) -> list[Cell]:
    """All that there is to do."""
    return [Cell(world, seed) for world in worlds for seed in range(seeds)]


def run_cells(study: Study, cells: Sequence[Cell], processes: int | None) -> list[dict[str, Any]] | None:
    """Do the cells that are not finished yet, and read all.

    Where torchrun started the program several times, each of the processes does its share of the cells, and then the
    first is sent what the others found and does not see in its folder.

    Args:
        study: what is done.
        cells: which.
        processes: at a time; None: all cores, or a single one for each process that torchrun started.

    Returns:
        The results in the order of `cells`; None in all processes of torchrun's but the first.

    Raises:
        ValueError: a cell failed, or a file is damaged.
        MemoryError: a process was killed.
        KeyboardInterrupt: the message says how to go on.
    """
    with launched() as fabric:
        if fabric is None:
            _do(study, cells, processes or os.cpu_count() or 1)
            return [study.read(cell) for cell in cells]
        if fabric.broadcast(study.folder.name) != study.folder.name:
            raise ValueError("versions: this machine has others than the first, or other priors in the same folders")
        gather(study, cells, fabric)
        missing = fabric.broadcast([cell for cell in cells if not study.finished(cell)])
        _do(study, missing[fabric.global_rank :: fabric.world_size], processes or 1, fabric)
        gather(study, cells, fabric)
        return [study.read(cell) for cell in cells] if fabric.is_global_zero else None


def gather(study: Study, cells: Sequence[Cell], fabric: "Fabric") -> None:
    """Send the first process the finished cells that it does not see, as where machines share no folder."""
    fabric.barrier()
    wanted = fabric.broadcast([cell.file for cell in cells if not study.finished(cell)])
    for rank in range(1, fabric.world_size):
        own: dict[str, bytes] = {}
        if rank == fabric.global_rank:
            files = (study.folder / name for name in wanted)
            own = {path.name: path.read_bytes() for path in files if path.exists()}
        sent = fabric.broadcast(own, src=rank)
        if fabric.is_global_zero:
            for name, content in sent.items():
                write_whole(study.folder / name, content)


@contextmanager
def launched() -> Iterator["Fabric | None"]:
    """The processes that torchrun started, which wait for one another; None for a program that was started once."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        yield None
        return
    from lightning import Fabric
    from lightning.fabric.plugins.environments import TorchElasticEnvironment
    from lightning.fabric.strategies import DDPStrategy

    from neuroprior.training import quiet

    threading.Thread(target=_end_without, args=(os.getppid(),), daemon=True).start()
    count, here = (int(os.environ[name]) for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
    strategy = DDPStrategy(
        cluster_environment=TorchElasticEnvironment(), process_group_backend="gloo", timeout=LONGEST_WAIT
    )
    with quiet():
        fabric = Fabric(accelerator="cpu", devices=here, num_nodes=count // here, strategy=strategy)
        fabric.launch()
    yield fabric
    torch.distributed.destroy_process_group()


def _end_without(parent: int) -> None:
    """End this process when torchrun, in whose session it is not, was killed: else it went on for hours by itself."""
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


def _do(study: Study, cells: Sequence[Cell], processes: int, fabric: "Fabric | None" = None) -> None:
    """Do those cells that are not finished yet; with a bar in the first process."""
    missing = [cell for cell in cells if not study.finished(cell)]
    first = fabric is None or fabric.is_global_zero
    if first:
        write_json(study.folder / "settings.json", asdict(study.settings))
    told = "cells" if fabric is None else f"cells of process 1 of {fabric.world_size}"
    with progress_bar(first) as progress:
        bar = progress.add_task(told, total=len(cells), completed=len(cells) - len(missing))
        try:
            do_each(partial(do, study), missing, processes, lambda cell: progress.advance(bar), fabric is not None)
        except KeyboardInterrupt as interrupted:
            kept = f"interrupted; finished cells are kept in {study.folder}, and the same command goes on"
            raise KeyboardInterrupt(kept) from interrupted


def do(study: Study, cell: Cell) -> None:
    """Do a cell and keep what was found; in one thread, as the number of threads changes the last digits.

    Raises:
        ValueError: the cell failed; the message names it.
        MemoryError: memory ran out; the message names the cell.
    """
    where = f"{cell.world}, seed {cell.seed}"
    try:
        with one_thread():
            found = study.run(WORLDS[cell.world], cell.seed, study.settings)
    except (ValueError, OSError, ImportError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from error
    except Exception as error:
        # torch has no exception of its own for memory that it could not get.
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "memory" in str(error)):
            raise MemoryError(f"{where}: out of memory; a smaller run may fit ({error})") from error
        error.add_note(f"in {where}")
        raise
    write_json(study.folder / cell.file, found)
