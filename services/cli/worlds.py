"""The commands about simulated worlds: `corridor world ...` and `corridor obstacle ...`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.options import (
    AtEpisodeOption,
    RobotOption,
    Sources,
    Which,
    grouped,
    import_installed,
)

WorldName = Annotated[
    str, typer.Argument(help="Name of the world, such as plus, or path of a world file.")
]
world = typer.Typer(
    help="Look at simulated worlds, and let robots drive in another.", no_args_is_help=True
)
obstacle = typer.Typer(help="Place and remove boxes where robots drive.", no_args_is_help=True)


@world.command("list")
def world_list() -> None:
    """List the worlds that come along and those in the folder worlds/."""
    worlds = import_installed("services.robot_driver.simulated.world", "sim")
    for name, path in worlds.world_files().items():
        loaded = worlds.read_world(path)
        x0, y0, x1, y1 = loaded.bounds
        laps = "laps" if loaded.lap else "no laps"
        size = f"{x1 - x0:.1f} x {y1 - y0:.1f} m"
        typer.echo(f"{name:16} {size:14} {laps:8} {path}  {loaded.title}")


@world.command("render")
def world_render(
    name: WorldName,
    out: Annotated[Path, typer.Option(help="Folder for the PNG files.")] = Path("renders"),
) -> None:
    """Write a top view and camera views of a world as PNG files."""
    views = import_installed("services.robot_driver.atlas.views", "sim")
    views.render(name, out)
    typer.echo(f"written to {out}")


@world.command("check")
@grouped
def world_check(sources: Sources, name: WorldName) -> None:
    """Print what is wrong with a world (exit code 1), or measure it: how hard it is, laps, tour."""
    worlds = import_installed("services.robot_driver.simulated.world", "sim")
    survey = import_installed("services.robot_driver.atlas.survey", "sim")
    path = worlds.world_path(name)
    loaded = sources.load({"robot.world": path.stem})
    problems = survey.problems_in(path, loaded)
    for line in problems:
        typer.echo(line)
    if problems:
        raise typer.Exit(1)
    for key, value in survey.survey(loaded, worlds.read_world(path)).items():
        typer.echo(f"{key:40} {value:.3f}" if isinstance(value, float) else f"{key:40} {value}")


# ---------------------------------------------------------------- while it runs


@world.command("switch")
@grouped
def world_switch(
    which: Which,
    name: Annotated[str, typer.Argument(help="World to drive in, such as minus.")],
    start: Annotated[int, typer.Option(min=0, help="Which of its start poses.")] = 0,
    at_episode: AtEpisodeOption = 0,
    robot: RobotOption = None,
) -> None:
    """Let robots of a running simulation go on in another world.

    Samples that look ahead across the change are dropped and counted.
    """
    change = {"kind": "switch", "world": name, "start": start, "at_episode": at_episode}
    raise typer.Exit(_change_world(which, robot, change))


@obstacle.command("place")
@grouped
def obstacle_place(
    which: Which,
    name: Annotated[str, typer.Argument(help="Name of the box, to remove it by.")],
    x: Annotated[float, typer.Option(help="Of its middle, m.")],
    y: Annotated[float, typer.Option(help="Of its middle, m.")],
    heading_deg: Annotated[float, typer.Option(help="Direction of its length.")] = 0.0,
    length: Annotated[float, typer.Option(help="m.")] = 0.5,
    width: Annotated[float, typer.Option(help="m.")] = 0.5,
    height: Annotated[float, typer.Option(help="m.")] = 0.5,
    rgb: Annotated[tuple[int, int, int], typer.Option(help="Colour, 0..255 each.")] = (200, 60, 40),
    at_episode: AtEpisodeOption = 0,
    robot: RobotOption = None,
) -> None:
    """Let a box stand in the world of a running simulation: solid, and seen."""
    box = {
        "name": name, "x_m": x, "y_m": y, "heading_deg": heading_deg, "length_m": length,
        "width_m": width, "height_m": height, "rgb": rgb,
    }  # fmt: skip
    change = {"kind": "place", "box": box, "at_episode": at_episode}
    raise typer.Exit(_change_world(which, robot, change))


@obstacle.command("remove")
@grouped
def obstacle_remove(
    which: Which,
    name: Annotated[str, typer.Argument(help="Name of the box.")],
    at_episode: AtEpisodeOption = 0,
    robot: RobotOption = None,
) -> None:
    """Take a box away again, one that was placed or one that belongs to the world."""
    change = {"kind": "remove", "name": name, "at_episode": at_episode}
    raise typer.Exit(_change_world(which, robot, change))


def _change_world(which: Which, robot: str | None, change: dict[str, Any]) -> int:
    """Wish for a change of the world of a run's robots; returns the exit code."""
    from services.monitor.operator import change_world

    return change_world(which.reach(), robot, **change)
