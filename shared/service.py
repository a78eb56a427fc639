"""What all services share: connecting, being visible, stopping cleanly, logging, exit codes."""

import logging
import math
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from logging.handlers import RotatingFileHandler
from pathlib import Path
from types import FrameType
from typing import TypeVar

from shared import roles
from shared.bus import Bus
from shared.complaints import Complaints
from shared.config import Config
from shared.errors import (
    BadMessage,
    BusError,
    ConfigError,
    CorridorError,
    DiskFull,
    PeerRefused,
    RobotMissing,
    RoleTaken,
    RouterMissing,
)
from shared.halts.keeper import HaltKeeper
from shared.inbox import Inbox
from shared.keys import PING, STOP
from shared.messages import PROTOCOL_VERSION, Ping, ServiceReply, StopService
from shared.threads import StopFlag as StopFlag
from shared.threads import Stopped as Stopped
from shared.threads import failing_together, jittered

VERSION = "0.1.0"
EXIT_OK, EXIT_CRASH = 0, 1
REJOIN_S = 10.0
"""After a sleep longer than its lease a process looks so long whether its role was taken."""
SETTLE_S = 3.0
"""Two processes that have met in one role compare their ages after this time, and again."""
TICK_S = 0.2
"""Longest a service waits before it looks at its stop flag."""
MOST_LOG_BYTES, LOGS_KEPT = 8 * 1024 * 1024, 3
T = TypeVar("T")
log = logging.getLogger(__name__)


def new_life() -> str:
    """A fresh random life id: 12 hex digits."""
    return secrets.token_hex(6)


class Service:
    """One running service: its bus, its stop flag, and its answers to `ping` and `stop`."""

    def __init__(
        self, name: str, ident: str, life: str, config: Config, bus: Bus, stop: StopFlag
    ) -> None:
        self.name, self.ident, self.life = name, ident, life
        self.config, self.bus, self.stop = config, bus, stop
        self.control: Inbox = bus.inbox()
        """Questions about this process; its thread serves them."""
        self.started_s = time.monotonic()
        self.log = logging.getLogger(name)
        self.rivals = 0
        """How often another life in this role was met."""
        self.taken_by = ""
        """Who has the role, if this process lost it."""

    def meet(self) -> None:
        """Win the role and become visible, where everybody speaks the same protocol and config.

        Raises RoleTaken naming who has the role, or ConfigError naming the first peer that differs.
        """
        with roles.claimed(self.bus, self.name, self.ident, self.life):
            fingerprint = self.config.fingerprint()
            for peer in self.bus.peers():
                if peer.protocol != str(PROTOCOL_VERSION):
                    raise ConfigError(
                        f"{self.name}: speaks protocol {PROTOCOL_VERSION}, but {peer.service} "
                        f"{peer.id!r} of run {self.config.run.name!r} speaks {peer.protocol}"
                    )
                if peer.config != fingerprint:
                    raise ConfigError(
                        f"{self.name}: has configuration {fingerprint}, but {peer.service} "
                        f"{peer.id!r} of run {self.config.run.name!r} has {peer.config}: start "
                        "both from one file"
                    )
            self._announce(self.ident)

    def take_role(self, ident: str) -> None:
        """Win another role of this service as well. Raises RoleTaken naming who has it."""
        with roles.claimed(self.bus, self.name, ident, self.life):
            self.serve_role(ident)
            self._announce(ident)

    def serve_role(self, ident: str) -> None:
        """Answer questions about a role."""
        for stream in (PING, STOP):
            self.control.serve(stream, f"{self.name}-{ident}")

    def _announce(self, ident: str) -> None:
        fingerprint = self.config.fingerprint()
        self.bus.announce(self.name, ident, self.life, PROTOCOL_VERSION, fingerprint)

    def serve_control(self) -> None:
        """Answer `ping` and `stop`, and watch over the role (runs in a thread of its own)."""
        inbox = self.control
        known, looked_s, woke_s = frozenset({self.life}), time.monotonic(), -math.inf
        asked_s = looked_s
        complaints = Complaints(self.log.error)
        while not self.stop.is_set():
            inbox.wait(TICK_S)
            for request in inbox.requests():
                with request:
                    request.reply(self.describe())
                    if isinstance(request.message, StopService):
                        self.stop.set("asked to stop")
            lives = inbox.lives(self.name, self.ident)
            for life in lives - known:
                self.rivals += 1
                complaints.tell("rival", f"another {self.name} {self.ident!r} is here: life {life}")
            known = lives | {self.life}
            away_s, looked_s = time.monotonic() - looked_s, time.monotonic()
            if away_s > self.config.bus.lease_ms / 1000:
                woke_s = looked_s
            if len(known) > 1 and looked_s - woke_s < REJOIN_S:
                # The role ended with the lease: whoever has it now keeps it.
                self.taken_by = ", ".join(sorted(known - {self.life}))
                self.stop.set("slept longer than its lease, and its role is taken by life")
            elif len(known) == 1:
                asked_s = looked_s
            elif looked_s - asked_s > SETTLE_S:
                asked_s = looked_s
                ident = f"{self.name}-{self.ident}"
                inbox.ask_all(PING, Ping(), ident=ident, timeout_s=SETTLE_S)
            for reply in inbox.answers(ServiceReply):
                if reply.life in known and roles.older(reply, self.describe()):
                    self.taken_by = reply.life
                    self.stop.set("met an older process in its role: life")

    def describe(self) -> ServiceReply:
        """Who this service is."""
        return ServiceReply(
            service=self.name,
            id=self.ident,
            life=self.life,
            host=socket.gethostname(),
            pid=os.getpid(),
            protocol=PROTOCOL_VERSION,
            version=VERSION,
            config=self.config.fingerprint(),
            uptime_s=time.monotonic() - self.started_s,
            rivals=self.rivals,
        )

    def insist(self, what: str, attempt: Callable[[], T], *, refusals: int = 0) -> T:
        """Repeat a request until it is answered, or a write until there is room; log long waits.

        refusals: how many refusals for good end it; 0: none does, as the request is always right.
        Raises Stopped, and PeerRefused after so many refusals.
        """
        start_s, next_report_s = time.monotonic(), 5.0
        while True:
            if self.stop.is_set():
                raise Stopped(what)
            try:
                return attempt()
            except (BusError, BadMessage, DiskFull) as error:
                if isinstance(error, PeerRefused) and error.final:
                    refusals -= 1
                    if refusals == 0:
                        raise
                waited_s = time.monotonic() - start_s
                if waited_s > next_report_s:
                    self.log.warning("still waiting to %s after %.0f s: %s", what, waited_s, error)
                    next_report_s *= 2
                self.stop.wait(jittered(min(max(waited_s / 4, 0.05), 1.0)))


_held: list[int] = []
"""Signals that came while this process's service was starting."""


@contextmanager
def starting() -> Iterator[None]:
    """Hold SIGTERM back until `answer_signals`: who starts comes to the same clean end as later."""
    _held.clear()
    before = signal.signal(signal.SIGTERM, lambda number, _: _held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def answer_signals(stop: StopFlag) -> None:
    """Let SIGTERM, SIGINT and a closed terminal set the flag; one held back does it now."""

    def on_signal(number: int, _: FrameType | None) -> None:
        stop.set(signal.Signals(number).name)

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as under nohup
        signal.signal(signal.SIGHUP, on_signal)
    for number in _held:
        on_signal(number, None)


@contextmanager
def service(
    name: str, ident: str, config: Config, *, life: str | None = None, halts: Path | None = None
) -> Iterator[Service]:
    """Connect, win the role and become visible; stop threads and close the bus at the end.

    halts: the run folder, in which a service without a robot keeps the halts that it hears of.

    Raises RoleTaken, also at the end if the role was lost meanwhile, and ConfigError.
    """
    stop = StopFlag()
    answer_signals(stop)
    with _connect(name, config, stop) as bus:
        me = Service(name, ident, life or new_life(), config, bus, stop)
        me.meet()
        with controlled(me):
            if halts is not None:
                HaltKeeper(me, halts)
            me.log.info("%s %r of run %r is up (life %s)", name, ident, config.run.name, me.life)
            yield me
    if me.taken_by:
        raise RoleTaken(f"{name} {ident!r} of run {config.run.name!r}: {stop.reason} {me.taken_by}")


@contextmanager
def controlled(me: Service) -> Iterator[None]:
    """Answer `ping` and `stop` while the block runs; the stop flag is set at its end."""
    me.serve_role(me.ident)
    me.control.watch(me.name, me.ident)
    thread = threading.Thread(target=me.serve_control, name="control", daemon=True)
    with failing_together(me.stop):
        thread.start()
        try:
            yield
        finally:
            me.stop.set("finished")
            thread.join(2.0)
            me.log.info("%s %r stops: %s", me.name, me.ident, me.stop.reason)


def _connect(name: str, config: Config, stop: StopFlag) -> Bus:
    """A bus, as soon as a router answers. Raises Stopped when told to stop first."""
    told = False
    while not stop.is_set():
        try:
            return Bus(config.bus, config.run.name)
        except RouterMissing as error:
            if not told:
                log.warning("%s waits for the router: %s", name, error)
                told = True
            stop.wait(jittered(TICK_S))
    raise Stopped("waiting for the router")


def setup_logging(name: str, folder: Path | None, *, screen: bool = True) -> None:
    """Log to `<folder>/logs/<name>.log`, if there is a folder, and to standard error."""
    handlers: list[logging.Handler] = [logging.StreamHandler()] if screen else []
    if folder is not None:
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        path = folder / "logs" / f"{name}.log"
        handlers.append(RotatingFileHandler(path, maxBytes=MOST_LOG_BYTES, backupCount=LOGS_KEPT))
    form = f"%(asctime)s {name} %(levelname)s %(message)s"
    logging.basicConfig(level=logging.INFO, format=form, handlers=handlers, force=True)


def guarded(name: str, main: Callable[[], None]) -> int:
    """Run a service's main function and turn how it ends into an exit code and one line."""
    try:
        main()
    except Stopped:
        return EXIT_OK
    except CorridorError as error:
        told = isinstance(error, RobotMissing | DiskFull) or error.exit_code != EXIT_CRASH
        log.error("%s", error, exc_info=not told)
        return error.exit_code
    except Exception:  # the only place: say what happened, then let the supervisor restart us
        log.exception("%s crashed", name)
        return EXIT_CRASH
    return EXIT_OK
