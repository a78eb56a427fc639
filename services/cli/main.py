"""The command line `corridor`: its groups of commands, and what becomes of their failures.

Commands import what they need when they run, so that `corridor driver` works without torch,
`corridor actor` works without pybullet, and `--help` is quick.

Exit codes: 0 done, 1 crash or no answer, 2 wrong configuration or usage (told in one line), 3 the
state on disk is damaged or does not belong to this run, 4 another process has the role.
"""

import re
from collections.abc import Sequence
from typing import Any

import typer

from services.cli import driving, experiments, looking, machines, run, services
from services.cli.emulate import emulate
from services.cli.secure import secure
from services.cli.worlds import obstacle, world
from shared.errors import ConfigError, CorridorError, meant

UsageError: Any = typer.BadParameter.__mro__[2]
"""Base of all complaints about the command line, wherever this version of Typer keeps Click."""

app = typer.Typer(
    help="A robot teaches itself to drive through corridors from one camera.",
    epilog="Exit codes: 0 done, 1 crash or no answer, 2 wrong configuration or usage, 3 bad state, "
    "4 role taken, 130 interrupted. `corridor --version` prints the version.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for group in (machines, driving, services, run, looking, experiments):
    group.add_to(app)
app.add_typer(world, name="world")
app.add_typer(obstacle, name="obstacle")
app.add_typer(emulate, name="emulate")
app.add_typer(secure, name="secure")


def main(arguments: Sequence[str] | None = None, *, first_halt: int | None = None) -> int:
    """Run the command line; every expected failure becomes one line and an exit code.

    first_halt: the number of an emergency stop that was sent already (`first_stop`).
    """
    try:
        code = app(arguments, prog_name="corridor", standalone_mode=False, obj=first_halt)
    except CorridorError as error:
        return _fail(str(error), error.exit_code)
    except UsageError as error:
        text = error.format_message()
        if bad := re.search(r"'([^']*)' is not one of (.*)\.", text):
            text += meant(bad[1], re.findall(r"'([^']+)'", bad[2]))
        return _fail(text, ConfigError.exit_code)
    except typer.Abort:  # nobody answered a question
        return _fail("nothing was changed", 1)
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    """Say in one line what went wrong; the source lines Zenoh appends help nobody here."""
    line = " ".join(re.sub(r" at \S+\.rs:\d+\.?", "", message).split())
    if line:  # empty after the help that a call without arguments shows
        typer.echo(f"corridor: {line}", err=True)
    return code
