"""What lies under `runs/`: which runs there are, how far each came, and what of it may go."""

import re
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from services.monitor.running import locked
from shared.config import Config
from shared.errors import ConfigError, StateError
from shared.place import RUNS, in_use
from shared.run_record import RUN, RunInfo, read_episodes
from shared.settings import flatten, read_folder

ANEW = ("tensorboard", "logs/*.[0-9]")
"""What may go: TensorBoard's numbers stand in the tables, too, and these logs are old."""


def found(folders: Sequence[Path]) -> list[Path]:
    """The runs in these folders and below them, or below `runs/`. Raises ConfigError."""
    runs = []
    for top in folders or [RUNS]:
        inside = sorted(path.parent for n in range(4) for path in top.glob("*/" * n + RUN))
        if folders and not inside:
            raise ConfigError(f"{top}: expected the folder of a run, with {RUN}; found none")
        runs += inside
    return list(dict.fromkeys(runs))


def read(folder: Path) -> tuple[RunInfo, list[dict[str, str]]]:
    """Record and episodes of a run. Raises StateError where they are damaged."""
    try:
        return RunInfo.model_validate_json((folder / RUN).read_bytes()), read_episodes(folder)
    except (OSError, ValueError) as error:
        raise StateError(f"{folder}: damaged: {str(error).splitlines()[0]:.60}") from error


def figures(folder: Path) -> dict[str, object]:
    """The main figures of a run; a damaged one says so."""
    try:
        info, rows = read(folder)
    except StateError as error:
        return {"run": error}
    preset = re.search(r"--preset[ =](\S+)", info.command)
    fitness = [float(row["fitness"]) for row in rows[-100:]]
    names = ("laps_left", "laps_right", "total_actions")
    left, right, actions = (rows[-1][name] if rows else "0" for name in names)
    return {
        "run": folder, "plan": info.experiment, "scale": info.scale, "seed": info.seed,
        "preset": preset[1] if preset else "-", "episodes": len(rows), "actions": actions,
        "fitness": f"{sum(fitness) / len(fitness):.1f}" if fitness else "-",
        "laps": f"{left} left {right} right", "size": _megabytes([folder]),
        "state": "complete" if info.complete else "up" if in_use(folder) else "stopped",
        "started": info.started,
    }  # fmt: skip


def listing(runs: Sequence[Path]) -> Table:
    """All runs, one a line."""
    told = [figures(run) for run in runs]
    table = Table(*max(told, key=len, default={}), box=None, pad_edge=False)
    for each in told:
        table.add_row(*map(str, each.values()))
    return table


def side_by_side(runs: Sequence[Path]) -> Table:
    """Settings that differ, of a run alone from the defaults; records, newest and main figures."""
    table = Table("", *map(str, runs), box=None, pad_edge=False)
    settings = [flatten(read_folder(run).to_dict()) for run in runs]
    others = settings if len(runs) > 1 else [flatten(Config().to_dict())]
    differ = [key for key in settings[0] if any(s[key] != o[key] for s in settings for o in others)]
    records = [{k: v for k, v in read(run)[0].model_dump().items() if v} for run in runs]
    newest = [(read(run)[1] or [{}])[-1] for run in runs]
    for trees in (settings, records, newest, list(map(figures, runs))):
        every = dict.fromkeys(key for tree in trees for key in tree)
        for key in differ if trees is settings else every:
            table.add_row(key, *(str(tree.get(key, "")) for tree in trees))
    return table


def show(table: Table) -> None:
    """Print a table, cut off nowhere but in a terminal."""
    width = None if sys.stdout.isatty() else 1000
    Console(markup=False, emoji=False, highlight=False, width=width).print(table)


def prune(
    runs: Sequence[Path], whole: bool, agreed: Callable[[str], bool], echo: Callable[[str], None]
) -> bool:
    """Remove what can be spared, or whole runs, once that is agreed to; whether it was.

    No run in use is touched, and none can be started meanwhile.
    """
    with ExitStack() as held:
        up = {run: f"{run}: up, left alone" for run in runs if in_use(run)}
        for run in (free := [run for run in runs if run not in up]):
            held.enter_context(locked(run))
        spared = [path for run in free for each in ANEW for path in run.glob(each)]
        going = free if whole else spared
        for line in (*up.values(), *(f"{path}: {_megabytes([path])}" for path in going)):
            echo(line)
        freed = _megabytes(going)
        if going and not agreed(f"remove these {len(going)}, {freed}?"):
            return False
        for path in going:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    echo(f"{freed} freed")
    return True


def _megabytes(paths: Sequence[Path]) -> str:
    """What files and folders take on disk; holes take nothing."""
    every = (each for path in paths for each in (path, *path.rglob("*")))
    return f"{sum(each.lstat().st_blocks * 512 for each in every) / 1e6:.1f} MB"
