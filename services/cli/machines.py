"""Commands for before the first metre: is this machine, and is this robot, ready?"""

import logging
from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import EndpointOption, RunDirOption, Sources, default_folder, grouped
from shared.errors import ConfigError

robot = typer.Typer(help="Look at a real robot, and measure it.", no_args_is_help=True)


@robot.callback()
def _robot() -> None:
    """Look at a real robot, and measure it."""
    logging.getLogger("services").addHandler(logging.NullHandler())  # faults are summed up


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(grouped(doctor))
    app.add_typer(robot, name="robot")


def doctor(sources: Sources, run_dir: RunDirOption = None, endpoint: EndpointOption = None) -> None:
    """Look whether this machine can run the system; change nothing.

    The last line says that it is ready, or what to do. Exit code 1 then.
    """
    from services.monitor.doctor import run

    loaded = sources.load({"bus.endpoint": endpoint})
    raise typer.Exit(run(loaded, run_dir or default_folder(loaded)))


@robot.command("check")
@grouped
def robot_check(
    sources: Sources,
    seconds: Annotated[float, typer.Option(min=1.0, max=600.0, help="How long to look.")] = 5.0,
) -> None:
    """Connect to a robot, list every sensor, and move nothing.

    The last line says that it is ready to drive, or what keeps it from that. Exit code 1 then.
    """
    from services.robot_driver.kinds import make_link
    from services.robot_driver.setup.check import check

    loaded = sources.load()
    problems = check(loaded.robot, make_link(loaded), seconds, typer.echo)
    typer.echo(f"not ready: {len(problems)} things to mend" if problems else "ready")
    raise typer.Exit(1 if problems else 0)


@robot.command("calibrate")
@grouped
def robot_calibrate(
    sources: Sources,
    out: Annotated[Path, typer.Option(help="Preset to write, such as my-robot.toml.")],
    space_m: Annotated[
        float, typer.Option(min=0.2, max=3.0, help="How far it may drive straight ahead.")
    ] = 0.6,
) -> None:
    """Drive a robot a little, measure what it makes of its commands, and write a preset.

    It needs free room: half a metre more than --space-m ahead, and half a metre around. Nothing
    is written if it touches something or if two measurements disagree.
    """
    from services.robot_driver.kinds import make_link
    from services.robot_driver.setup.calibrate import calibrated
    from shared.provenance import commit
    from shared.run_record import now_utc
    from shared.settings import preset_text
    from shared.statefile import write_atomically

    if out.exists():
        raise ConfigError(f"--out: {out} exists already")
    config = sources.load()
    name = f"{config.robot.kind} {config.robot.id}"
    made = f"corridor robot calibrate, {name}, {now_utc()}, {commit()}"
    found = calibrated(config, make_link(config), space_m, made, typer.echo)
    head = f"# {made}\n# max_dist (Eq 3.2): {found.max_distance_m:.3f} m\n\n"
    write_atomically(out, (head + preset_text(found)).encode())
    typer.echo(f"written to {out}: use it with --preset {out}")
