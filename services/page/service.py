"""`corridor page`: puts the parts of the page together and serves them until it is stopped."""

import os
from collections.abc import Callable
from pathlib import Path

import typer

from services.page import address
from services.page.browse import Browser
from services.page.commands import Desk
from services.page.folder import Folder
from services.page.server import Server
from services.page.watch import Watch
from shared.config import Config
from shared.place import RUNS, is_up, those_up
from shared.service import setup_logging
from shared.threads import stop_on_signals


def run(
    folder: Path | None, given: bool, reach: Callable[[], Config], host: str, port: int, open_: bool
) -> int:
    """Show a run until asked to stop.

    folder: that of the run; None: the run that commands reach. given: the endpoint was chosen on
    purpose, whether or not a `corridor up` holds the folder. open_: strangers may look. Raises
    ConfigError: nobody may listen there, or several runs are up and none was chosen.
    """
    if folder is None and (up := RUNS / reach().run.name) in those_up():
        folder = up
    setup_logging("page", folder)
    kept = folder / "page" if folder else None
    place, found = address.listen(kept, host, port, insecure=open_)
    typer.echo(found.url)

    def now() -> Config | None:
        return reach() if given or not folder or is_up(folder) else None

    memory = Browser(folder)
    # uvicorn repeats a signal when it is done: it ends nothing then.
    with stop_on_signals(), Watch(now, Folder(folder) if folder else None) as watch:
        desk = Desk(watch)
        watch.told = desk.told
        Server(watch, desk, memory, found).serve(place)
    memory.end()
    return os.EX_OK
