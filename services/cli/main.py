"""The command line `corridor`: every service alone, all together, and a look at what runs.

Commands import what they need when they run: `corridor driver` works without torch, `corridor
actor` without pybullet, and `--help` is quick.

Exit codes: 0 done, 1 crash or nobody answers, 2 wrong configuration or usage (one line), 3 what
lies on disk is damaged or does not belong to this run.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli import driving
from services.cli.emulate import emulate
from services.cli.options import (
    CHOOSE,
    EXIT_CONFIG,
    EXIT_CRASH,
    EXIT_STATE,
    ConfigFile,
    Endpoint,
    Preset,
    Robot,
    Run,
    RunDir,
    Seed,
    Set,
    Tethered,
    import_role,
    load,
    reach,
)
from services.cli.worlds import obstacle, world
from services.launcher.tether import tether
from shared.errors import ConfigError, CorridorError, StateError

if TYPE_CHECKING:
    from services.monitor.operator import Command
    from shared.config import Config

UsageError: Any = typer.BadParameter.__mro__[2]
"""Base of all complaints about the command line, wherever this version of Typer keeps Click."""

app = typer.Typer(
    help="A robot teaches itself to drive through corridors from one camera.",
    epilog="Exit codes: 0 done, 1 crash or no answer, 2 wrong configuration or usage, 3 bad state.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(world, name="world")
app.add_typer(obstacle, name="obstacle")
app.add_typer(emulate, name="emulate")
driving.add_to(app)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; every expected failure becomes one line and an exit code."""
    try:
        code = app(arguments, prog_name="corridor", standalone_mode=False)
    except ConfigError as error:
        return _fail(str(error), EXIT_CONFIG)
    except StateError as error:
        return _fail(str(error), EXIT_STATE)
    except CorridorError as error:
        return _fail(str(error), EXIT_CRASH)
    except UsageError as error:
        return _fail(error.format_message(), EXIT_CONFIG)
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    """Say in one line what went wrong; the source lines Zenoh appends help nobody here."""
    line = " ".join(re.sub(r" at \S+\.rs:\d+\.?", "", message).split())
    if line:  # empty after the help that a call without arguments shows
        typer.echo(f"corridor: {line}", err=True)
    return code


# ---------------------------------------------------------------- services


def _service_command(name: str, package: str, text: str) -> None:
    """Add the command that runs one service in this process."""

    def command(
        preset: Preset = None,
        config: ConfigFile = None,
        set_: Set = None,
        seed: Seed = None,
        run: Run = None,
        run_dir: RunDir = None,
        endpoint: Endpoint = None,
        tethered: Tethered = False,
    ) -> None:
        loaded = load(preset, config, set_, run, seed, endpoint)
        raise typer.Exit(_serve(name, package, loaded, run_dir or _folder(loaded), tethered))

    app.command(name, help=text)(command)


_service_command(
    "driver",
    "robot_driver",
    "Drive one robot: camera, motion, limits, bumper reflex, emergency stop.",
)
_service_command(
    "actor", "actor", "Choose actions with the target network and hand episodes to replay."
)
_service_command(
    "replay", "replay", "Keep the replay memory on disk: store, discard, equalise, serve changes."
)
_service_command(
    "learner", "learner", "Train the network, keep checkpoints, publish the target network."
)


@app.command()
def router(
    preset: Preset = None,
    config: ConfigFile = None,
    set_: Set = None,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Where to listen; default bus.endpoint, which is loopback only. Port 0 takes a "
            "free port. Example for all interfaces: tcp/0.0.0.0:7447."
        ),
    ] = None,
    tethered: Tethered = False,
) -> None:
    """Run a Zenoh router; the first line on standard output is where it listens."""
    loaded = load(preset, config, set_, endpoint=listen)
    if tethered:
        tether()
    from services.router.service import run as route

    route(loaded.bus.endpoint, typer.echo)


@app.command()
def up(
    preset: Preset = None,
    config: ConfigFile = None,
    set_: Set = None,
    run: Run = None,
    seed: Seed = None,
    run_dir: RunDir = None,
    endpoint: Annotated[
        str | None,
        typer.Option(
            help="Use the router at this endpoint instead of starting one.",
            rich_help_panel=CHOOSE,
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Where the own router listens; default: loopback, a free port.",
            rich_help_panel=CHOOSE,
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(help="End by itself after so many episodes (run.episodes); 0: never."),
    ] = None,
) -> None:
    """Start router, replay, learner, actor and driver, and show how the robot learns.

    Ctrl-C stops everything within five seconds; the same command continues the run. All that a
    run produces lies in its folder.
    """
    loaded = load(preset, config, set_, run, seed, endpoint, {"run.episodes": episodes})
    from services.launcher.up import run_all

    code = run_all(loaded, run_dir or _folder(loaded), listen=listen, given=endpoint is not None)
    raise typer.Exit(code)


# ---------------------------------------------------------------- looking and commanding


@app.command()
def status(
    run: Run = None,
    run_dir: RunDir = None,
    endpoint: Endpoint = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    require: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SERVICE",
            help="Exit with 1 unless this service answers; repeatable (for health checks).",
        ),
    ] = None,
) -> None:
    """List the services of a run that are alive, with versions, rates and memory."""
    from services.monitor.status import show

    raise typer.Exit(show(reach(run, run_dir, endpoint), as_json=as_json, require=require or []))


@app.command()
def stop(
    run: Run = None,
    run_dir: RunDir = None,
    endpoint: Endpoint = None,
    service: Annotated[
        list[str] | None,
        typer.Option(metavar="SERVICE", help="only this service (driver, actor, ...); repeatable."),
    ] = None,
) -> None:
    """Ask the services of a run to stop cleanly; `corridor up` ends with them."""
    from services.monitor.operator import stop_services

    raise typer.Exit(stop_services(reach(run, run_dir, endpoint), service or []))


def _robot_command(name: Command, text: str) -> None:
    """Add a command that robots acknowledge."""

    def command(
        run: Run = None, run_dir: RunDir = None, endpoint: Endpoint = None, robot: Robot = None
    ) -> None:
        from services.monitor.operator import command_robots

        raise typer.Exit(command_robots(reach(run, run_dir, endpoint), name, robot))

    app.command(name, help=text)(command)


_robot_command("estop", "Stop robots at once; they stay stopped until `corridor clear`.")
_robot_command("clear", "Release the emergency stop of robots.")
_robot_command("pause", "Let robots wait after the current action, until `corridor resume`.")
_robot_command("resume", "Let paused robots drive on.")


# ---------------------------------------------------------------- without a run


@app.command("config")
def show_config(preset: Preset = None, config: ConfigFile = None, set_: Set = None) -> None:
    """Print the resolved configuration as TOML, every key with its value."""
    from shared.settings import to_toml

    typer.echo(to_toml(load(preset, config, set_)), nl=False)


# ---------------------------------------------------------------- experiments


@app.command()
def experiment(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Plans, such as plus-rmm; none: list them."),
    ] = None,
    scale: Annotated[
        str, typer.Option(help="full: the thesis's constants; mini: minutes instead of days.")
    ] = "mini",
    seeds: Annotated[
        int, typer.Option(min=1, help="How many of the plan's seeds, from the first.")
    ] = 1,
    seed: Annotated[int | None, typer.Option(help="This seed alone.")] = None,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Runs side by side.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of all runs; default runs/experiments.")
    ] = None,
) -> None:
    """Run experiments in this process, without a router; run again, they go on.

    A plan that begins with the end of another runs that one first.
    """
    commands = import_role("experiments.runs.commands", "experiments")
    if not names:
        typer.echo(commands.listing())
        return
    raise typer.Exit(commands.run(names, scale, seeds, seed, jobs, out))


@app.command()
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUNS...", help="Folders of seeds, of experiments, or of several experiments."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the pages.")] = Path("report"),
    gpu_step_ms: Annotated[
        float | None,
        typer.Option(help="Measured time of a GPU's gradient step; adds projected hours.", min=0),
    ] = None,
) -> None:
    """Write figures, tables and findings of finished runs as HTML and Markdown."""
    report = import_role("experiments.report.full_report", "experiments")
    pages = report.write_report(runs, out, gpu_step_ms)
    typer.echo(f"written: {pages[0]} and {len(pages) - 1} Markdown pages beside it")


@app.command()
def evaluate(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="Folder of a run, or a .safetensors file of weights."),
    ],
    world: Annotated[
        str | None, typer.Option(help="Where to drive; default: the run's world.")
    ] = None,
    starts: Annotated[int, typer.Option(help="Number of drives.", min=1, max=1000)] = 16,
    actions: Annotated[int, typer.Option(help="Of each drive.", min=1, max=100_000)] = 400,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results; default: evaluation-WORLD.")
    ] = None,
    config: ConfigFile = None,
    set_: Set = None,
) -> None:
    """Drive with a run's network, frozen, beside random actions and the planner.

    The run's own config.toml tells robot and network; --config and --set stand in for a missing one
    or change it.
    """
    command = import_role("experiments.drives.evaluate", "experiments")
    file = config or import_role("services.commander.frozen", "actor").configuration_of(run)
    loaded = load(None, file, set_, others={"robot.world": world})
    folder = out or Path(f"evaluation-{loaded.robot.world}")
    command.run(run, loaded, starts, actions, folder)
    typer.echo(f"written to {folder}")


# ---------------------------------------------------------------- shared by the commands


def _folder(config: Config) -> Path:
    """The default folder of a run."""
    return Path("runs") / config.run.name


def _serve(name: str, package: str, config: Config, folder: Path, tethered: bool) -> int:
    """Run one service until it stops; returns its exit code."""
    if tethered:
        tether()
    from shared.service import guarded, setup_logging, starting
    from shared.settings import claim

    claim(folder, config)
    setup_logging(name, folder)

    def run() -> None:
        with starting():
            import_role(f"services.{package}.service", name).run(config, folder)

    return guarded(name, run)


if __name__ == "__main__":
    sys.exit(main())
