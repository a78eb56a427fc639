"""Commands that tell of runs: `diagnose`, `runs` and `streams`."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from services.cli.options import Which, grouped, import_installed


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (diagnose, runs, streams):
        app.command()(grouped(command))


def diagnose(
    run: Annotated[Path | None, typer.Argument(help="Default: what is up, or runs/demo.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON array.")] = False,
) -> None:
    """Tell why a run does not learn: what was measured, what is usual, what to do.

    Exit code 1 when something is found.
    """
    from services.monitor.diagnose import Evidence, findings
    from services.monitor.status import look
    from shared import place, run_record, settings
    from shared.errors import StateError

    folder = run or next(iter(place.those_up()), place.RUNS / "demo")
    config, episodes = settings.read_folder(folder), run_record.read_episodes(folder)
    live = look(Which(run_dir=folder).reach())[1] if place.is_up(folder) else None
    tables = import_installed("services.replay.tables", "replay")
    memory = import_installed("shared.rl.memory", "replay").ReplayMemory(config.memory.capacity)
    try:
        tables.Tables(folder / "replay", readonly=True).update(memory)
    except StateError:
        memory = None
    found = findings(Evidence(config, episodes, memory, live, _logged(folder)))
    if as_json:
        typer.echo(json.dumps([vars(finding) for finding in found], indent=2))
    else:
        blind = "" if memory else ", no replay memory: camera and actions are not judged"
        typer.echo(f"{folder}: {len(episodes)} episodes, {'' if live else 'not '}up{blind}")
        for it in found:
            told = (
                f"{it.illness}: {it.measured}\n    usual: {it.usual}\n    what to do: {it.remedy}"
            )
            typer.echo(told)
        typer.echo(f"{len(found)} found" if found else "nothing found")
    raise typer.Exit(1 if found else 0)


def _logged(folder: Path) -> list[str]:
    """What replay and learner logged since each last started."""
    paths = (folder / "logs" / f"{name}.log" for name in ("replay", "learner"))
    logs = (path.read_text(errors="replace") for path in paths if path.exists())
    return [line for log in logs for line in log.rpartition(" is up (life ")[2].splitlines()]


def runs(
    action: Annotated[Literal["list", "show", "compare", "prune"], typer.Argument()] = "list",
    folders: Annotated[list[Path] | None, typer.Argument(help="Default: all below runs.")] = None,
    whole: Annotated[bool, typer.Option("--whole", help="prune: whole runs.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="prune: do not ask.")] = False,
) -> None:
    """List runs, show one, compare several, or prune what can be spared.

    prune removes old logs and TensorBoard's files, whose numbers stand in the tables. It says what
    goes and asks. What is up is left alone.
    """
    from services.monitor import runs as there
    from shared.errors import ConfigError

    found = there.found(folders or [])
    if not folders and (action in ("show", "compare") or whole):
        raise ConfigError(f"{action}: expected the folder of a run")
    if action == "prune":
        agreed = (lambda _: True) if yes else typer.confirm
        raise typer.Exit(0 if there.prune(found, whole, agreed, typer.echo) else 1)
    there.show(there.listing(found) if action == "list" else there.side_by_side(found))


def streams(
    which: Which,
    action: Annotated[Literal["top", "hz", "echo"], typer.Argument()] = "top",
    stream: Annotated[str, typer.Argument(help="Such as observation.")] = "",
    seconds: Annotated[float, typer.Option(min=0.0, help="End after so long; 0: at Ctrl-C.")] = 0.0,
) -> None:
    """Watch what is published, once a second: top shows rate, size, age and content of all.

    hz shows those of one stream, echo prints its messages as JSON.
    """
    from services.monitor.streams import watch

    watch(which.reach(), action, stream, seconds)
