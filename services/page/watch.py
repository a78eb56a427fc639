"""What the page knows: one thread listens to the run and reads its folder, and tells it as JSON.

It is told in sections. One that has not changed stays the same object, so that each browser gets
only what is new to it. Of a run that is not up, the folder alone is told.
"""

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Self

from services.launcher.live import RunView, warnings
from services.monitor import words
from services.monitor.heartbeats import Reader, Snapshot
from services.page.folder import Folder, map_of
from services.page.track import Track
from services.robot_driver.simulated.world import world_files
from shared.bus import Bus
from shared.codec import decode
from shared.config import Config
from shared.errors import BadMessage, RouterMissing
from shared.inbox import MAX_SENDERS, Inbox
from shared.keys import ACTION, OBSERVATION, PING, Stream, check_sender
from shared.messages import Ping, ServiceReply

log = logging.getLogger(__name__)
PERIOD_S, IDLE_PERIOD_S = 0.2, 1.0
"""How often the page looks, with and without a browser."""
READ_S, JUDGED_S, AWAY_S = 2.0, 10.0, 3.0
"""How often the folder is read and services are asked, how often the run is judged; how long a
router may be away."""
KEPT = 2048
"""Messages of and for one robot between two looks."""


class Stamped:
    """Observations and actions with the time at which each came, until they are taken."""

    def __init__(self, bus: Bus) -> None:
        self._lock = threading.Lock()
        self._queues: dict[str, deque[tuple[float, Stream, bytes]]] = {}
        self.lost = 0
        """Messages for which there was no room, or that could not be read."""
        for stream in (OBSERVATION, ACTION):
            bus.subscribe(stream, "*", partial(self._keep, stream))

    def _keep(self, stream: Stream, robot: str | None, data: bytes) -> None:
        now_s = time.monotonic()
        with self._lock:
            if robot is None or (robot not in self._queues and len(self._queues) >= MAX_SENDERS):
                self.lost += 1
                return
            queue = self._queues.setdefault(robot, deque(maxlen=KEPT))
            self.lost += len(queue) == KEPT
            queue.append((now_s, stream, data))

    def into(self, tracks: dict[str, Track]) -> None:
        """Tell the tracks of the robots what has come."""
        with self._lock:
            taken, self._queues = self._queues, {}
        for robot, queue in taken.items():
            if robot not in tracks and len(tracks) >= MAX_SENDERS:
                self.lost += len(queue)
                continue
            track = tracks.setdefault(robot, Track())
            for at_s, stream, data in queue:
                try:
                    message = decode(data, stream.request)
                    check_sender(stream, robot, message)
                    track.take(message, at_s)
                except BadMessage:
                    self.lost += 1


class Watch:
    """Looks at a run again and again. Use as a context manager.

    reach: how the run is reached now; None while it is not up. folder: None on another machine.
    """

    def __init__(self, reach: Callable[[], Config | None], folder: Folder | None) -> None:
        self._reach, self.folder = reach, folder
        self.sections: Mapping[str, str] = {"worlds": json.dumps([*world_files()])}
        """The newest of each section as JSON; replaced as a whole."""
        self.snapshot, self.tracks, self.lost = Snapshot(), dict[str, Track](), 0
        self.bus: Bus | None = None
        """The open connection; None without a router."""
        self.browsers = 0
        """How many look; the server counts them."""
        self.told: Callable[[], object] = list
        """What became of the newest orders."""
        self._replies: dict[str, ServiceReply] = {}
        self._done = threading.Event()
        self._read_s = self._judged_s = 0.0
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join(3.0)

    def _watch(self) -> None:
        while not self._done.is_set():
            try:
                self._look()
            except Exception:  # it must look again, whatever it is
                log.exception("the page begins to watch anew")
            self._done.wait(IDLE_PERIOD_S)

    def _look(self) -> None:
        """Watch as long as a router answers; tell the folder alone without one."""
        config = self._reach()
        try:
            if config:
                with Bus(config.bus, config.run.name) as self.bus:
                    self._listen(self.bus, config)
        except RouterMissing as error:
            log.debug("%s", error)
        finally:
            self.bus = None
        self._tell(config, 0.0)

    def _listen(self, bus: Bus, config: Config) -> None:
        """Watch until the page ends, or the router is away for so long that it may be elsewhere."""
        inbox, stamped = bus.inbox(), Stamped(bus)
        reader, begun_s = Reader(inbox), time.monotonic()
        heard_s = begun_s
        while not self._done.wait(PERIOD_S if self.browsers else IDLE_PERIOD_S):
            now_s = time.monotonic()
            heard_s = now_s if bus.connected else heard_s
            if now_s - heard_s > AWAY_S:
                return
            reader.update()
            stamped.into(self.tracks)
            self.snapshot, self.lost = reader.snapshot(), stamped.lost
            if now_s - self._read_s >= READ_S:
                self._ask(bus, inbox)
            self._tell(config, now_s - begun_s if heard_s == now_s else 0.0)

    def _ask(self, bus: Bus, inbox: Inbox) -> None:
        """Ask every service who it is; take the answers to the last time."""
        self._replies = {reply.life: reply for reply in inbox.answers(ServiceReply)}
        for peer in bus.peers():
            with suppress(ValueError):  # an id from outside may be too long for a key
                inbox.ask_all(PING, Ping(), ident=f"{peer.service}-{peer.id}", timeout_s=READ_S)

    def _tell(self, config: Config | None, connected_s: float) -> None:
        """Renew the sections. The folder is looked at now and then."""
        worlds = {name: track.seen.world for name, track in self.tracks.items() if track.seen}
        sections: dict[str, object] = {
            "state": {**self._state(config), "connected": connected_s > 0.0},
            "robots": {name: track.shown() for name, track in self.tracks.items()},
            "trails": {n: [[*t.trail], [*t.bumps]] for n, t in self.tracks.items()},
            "maps": {world: map_of(world) for world in sorted(set(worlds.values()))},
            "told": self.told(),
        }
        now_s, folder = time.monotonic(), self.folder
        if folder:
            boxes = {name: folder.obstacles(name, world) for name, world in worlds.items()}
            sections["obstacles"] = boxes
        if folder and now_s - self._read_s >= READ_S:
            self._read_s, sections["notes"] = now_s, folder.notes()
            if curves := folder.curves():
                sections["curves"] = curves
        if folder and now_s - self._judged_s >= JUDGED_S:
            self._judged_s = now_s
            seen = self.snapshot if connected_s > JUDGED_S / 2 else None
            sections["findings"] = folder.findings(seen)
        old = self.sections
        fresh = {name: json.dumps(what) for name, what in sections.items()}
        same = {name: old[name] for name, text in fresh.items() if old.get(name) == text}
        self.sections = {**old, **fresh, **same}

    def _state(self, config: Config | None) -> dict[str, Any]:
        """What the heartbeats tell, how old they are, and what is wrong."""
        seen, heartbeat_s = self.snapshot, config.bus.heartbeat_s if config else 1.0
        told: dict[str, Any] = {
            "run": config.run.name if config else self.folder.path.name if self.folder else "",
            "lost": self.lost,
            "warnings": warnings(RunView("", "", 0.0, seen, heartbeat_s=heartbeat_s)),
            "services": {
                name: {
                    **entry.message.model_dump(),
                    "age_s": round(entry.age_s, 1),
                    "silent": entry.age_s > 3 * heartbeat_s,
                    "reply": reply.model_dump() if reply else None,
                }
                for name, entry in seen.everybody.items()
                for reply in [self._replies.get(entry.message.life)]
            },
        }
        if seen.replay and seen.learner:
            told["replay"] = words.replay_doing(seen.replay.message)
            told["learner"] = words.learner_doing(seen.learner.message)
            told["fitting"] = words.fit_share(seen.learner.message)
        return told
