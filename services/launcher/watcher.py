"""How a run looks from the bus, and the one order that `corridor up` gives its robots."""

import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Self

from services.monitor.heartbeats import Reader, Snapshot
from services.processes import ACTOR
from services.security.use import using
from shared.bus import Bus
from shared.config import Config
from shared.errors import RouterMissing
from shared.halts.book import ALL
from shared.halts.orders import order

log = logging.getLogger(__name__)
LOOK_S = 0.25


@dataclass(frozen=True)
class Sight:
    """One look at the bus."""

    snapshot: Snapshot = field(default_factory=Snapshot)
    connected: bool = False
    """Whether the router answers; without it nobody is heard."""
    commanded: frozenset[str] = frozenset()
    """Robots that somebody else than the run's actor commands, such as `corridor drive`."""


class Watcher:
    """Reads heartbeats, from the moment the router answers. Use as a context manager.

    A thread does it, because connecting may take a second, and Ctrl-C must not wait for that.
    """

    def __init__(self, config: Config) -> None:
        bus = config.bus.model_copy(update={"shared_memory": False})
        config = config.model_copy(update={"bus": bus})
        self._config = using(config, "operator", "watcher")
        self._done = threading.Event()
        self._bus: Bus | None = None
        self.sight = Sight()
        """The newest look; replaced as a whole by each one."""
        self.told = ""
        """What became of the last order, and when."""
        self._thread = threading.Thread(target=self._watch, name="watcher", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()
        self._thread.join(2.0)

    def release(self) -> None:
        """Begin to leave the bus, without waiting for it."""
        self._done.set()

    def halt(self) -> None:
        """Stop all robots now, over the connection that is open (any thread).

        It goes on until all stand, and tells on the way which do.
        """
        at, told = time.strftime("%H:%M:%S"), list[str]()

        def tell(line: str) -> None:
            log.warning("emergency stop: %s", line)
            told.append(line)
            self.told = f"{at} emergency stop: {'; '.join(told)}"

        if self._bus is None:
            tell("NOT sent: no router answers")
            return
        tell("sent")
        try:
            stand = order(self._bus, "estop", ALL, tell, ended=self._done.is_set)
        except Exception as error:  # noqa: BLE001  (whatever it is, the person must see it)
            tell(str(error))
        else:
            tell("all stand" if stand else "not all stand")

    def _watch(self) -> None:
        while not self._done.is_set():
            try:
                with Bus(self._config.bus, self._config.run.name) as self._bus:
                    self._look(self._bus)
            except Exception as error:  # it must look again, whatever it is
                if not isinstance(error, RouterMissing):
                    log.exception("the watcher begins anew")
                self.sight = Sight()
                self._done.wait(LOOK_S)
        self._bus = None

    def _look(self, bus: Bus) -> None:
        reader, own = Reader(inbox := bus.inbox()), self._config.run.robots
        inbox.watch(ACTOR.name)
        while not self._done.wait(LOOK_S):
            reader.update()
            seen = reader.snapshot()
            others = {r for r in seen.robots if r not in own and inbox.lives(ACTOR.name, r)}
            self.sight = Sight(seen, bus.connected, frozenset(others))
