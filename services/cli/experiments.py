"""The commands about experiments and what runs leave behind: run, report, evaluate."""

from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import ConfigOption, SetOption, Sources, import_installed


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (experiment, retention, report, evaluate, export, video):
        app.command()(command)


def experiment(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Plans, such as plus-rmm; none: list them."),
    ] = None,
    scale: Annotated[
        str,
        typer.Option(
            help="full: the thesis's constants; fifth, tenth: smaller, with a narrow network; "
            "fifth-wide, tenth-wide: with the full one."
        ),
    ] = "tenth",
    seeds: Annotated[
        int, typer.Option(min=1, help="How many of the plan's seeds, from the first.")
    ] = 1,
    seed: Annotated[int | None, typer.Option(help="This seed alone.")] = None,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Runs side by side.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of all runs; default runs/experiments.")
    ] = None,
    describe: Annotated[
        bool, typer.Option("--describe", help="Run nothing; compare this scale with the full one.")
    ] = False,
) -> None:
    """Run experiments in this process, without a router; run again, they go on.

    A plan that begins with the end of another runs that one first.
    """
    commands = import_installed("experiments.runs.schedule", "experiments")
    if not names:
        typer.echo(commands.listing())
        return
    if describe:
        typer.echo(commands.described(names, scale))
        return
    raise typer.Exit(commands.run(names, scale, seeds, seed, jobs, out))


def retention(
    setting: Annotated[
        str, typer.Option(help="Which stream: see docs/comparison.md.")
    ] = "standard",
    seed: Annotated[
        list[int] | None, typer.Option(min=1, help="This seed; may be repeated. Default: all.")
    ] = None,
    entry: Annotated[
        list[str] | None, typer.Option(help="This entry; may be repeated. Default: all.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of streams and results; default runs/retention.")
    ] = None,
) -> None:
    """Compare what strategies keep of the same stream: networks learn from it, and drive.

    Run again, it goes on. A stream takes a gigabyte.
    """
    command = import_installed("experiments.retention.work", "experiments")
    console = import_installed("rich.console", "experiments").Console()
    raise typer.Exit(command.run(setting, seed or [], entry or [], out, console))


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUNS...", help="Folders of seeds, of experiments, or of several experiments."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the pages.")] = Path("report"),
) -> None:
    """Write figures, tables and findings of finished runs as HTML and Markdown."""
    full_report = import_installed("experiments.report.full_report", "experiments")
    pages = full_report.write_report(runs, out)
    typer.echo(f"written: {pages[0]} and {len(pages) - 1} Markdown pages beside it")


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
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Drive with a run's network, frozen, beside random actions and the planner.

    The run's own config.toml tells robot and network; --config and --set stand in for a missing one
    or change it.
    """
    command = import_installed("experiments.drives.evaluate_command", "experiments")
    file = config or import_installed("services.commander.frozen", "actor").configuration_of(run)
    loaded = Sources(None, file, set_).load({"robot.world": world})
    folder = out or Path(f"evaluation-{loaded.robot.world}")
    command.run(run, loaded, starts, actions, folder)
    typer.echo(f"written to {folder}")


def export(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="weights: the network as ONNX; memory: samples, metrics: episodes as Parquet.",
        ),
    ],
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[Path, typer.Option(help="File to write, such as demo.onnx or demo.parquet.")],
) -> None:
    """Write what a run left behind in a form that other programs read."""
    typer.echo(import_installed("experiments.export", "export").write(what, run, out))


def video(
    source: Annotated[
        Path,
        typer.Argument(metavar="RUN|RECORDING", help="Folder of a run, its weights, or an .mcap."),
    ],
    out: Annotated[Path, typer.Option(help="File to write, such as lap.mp4 or lap.gif.")],
    world: Annotated[
        str | None, typer.Option(help="Where a network drives; default: where it learnt.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=100_000, help="Most of them.")] = 400,
    parts: Annotated[
        int, typer.Option(min=1, max=100, help="Show so many parts of a recording, evenly spread.")
    ] = 1,
    speed: Annotated[float, typer.Option(min=0.1, max=100.0, help="Times faster than it was.")] = 4,
) -> None:
    """Film a recording, or a drive with the frozen network of a run: image, predictions, map."""
    command = import_installed("experiments.drives.video_command", "experiments")
    typer.echo(command.run(source, out, world, frames, parts, speed))
