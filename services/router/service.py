"""Our own router: a Zenoh session in router mode. The official `zenohd` may take its place."""

import logging
from collections.abc import Callable
from pathlib import Path

from services.security.use import refuse_open_door
from shared.bus import open_router
from shared.threads import stop_on_signals

TICK_S = 0.2
"""Python takes up a signal only where its main thread runs, and the signal may wake another one."""
log = logging.getLogger(__name__)


def run(
    endpoint: str,
    announce: Callable[[str], None],
    credentials: str = "",
    *,
    insecure: bool = False,
    shared_memory: bool = False,
) -> None:
    """Route until SIGTERM or SIGINT. Raises ConfigError when it cannot or must not listen there.

    announce: called with the locator that clients connect to. credentials: folder of the router,
    with its configuration; empty: open to everybody, with `insecure` from anywhere.
    """
    refuse_open_door(endpoint, credentials, insecure)
    file = Path(credentials) / "router.json5" if credentials else None
    with (
        stop_on_signals() as stop,
        open_router(endpoint, file, shared_memory=shared_memory) as locator,
    ):
        log.info("router listens on %s", locator)
        announce(locator)
        while not stop.wait(TICK_S):
            pass
    log.info("router stops")
