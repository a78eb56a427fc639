"""The replay service: three threads around one set of files.

intake  commits episodes and answers short questions; owns the counters
bulk    streams changes, snapshots and mini-batches from read transactions
turns   owns the memory (`worker.TurnWorker`)
"""

import threading
import time
from collections.abc import Iterable
from pathlib import Path

from services.processes import MAIN
from services.replay.footprint import gather_heap
from services.replay.numbering import MAX_ROBOTS, Counters, filling, progress_of
from services.replay.storage import Refused, Storage
from services.replay.worker import TurnWorker
from shared.bus import Request
from shared.complaints import Complaints
from shared.config import Config
from shared.errors import DiskFull
from shared.inbox import Inbox
from shared.keys import CHANGES, EPISODE, MINI_BATCH, PROGRESS, REPLAY_STATE, SNAPSHOT, TURNS
from shared.messages import (
    ChangesRequest,
    Episode,
    EpisodeAck,
    Message,
    MiniBatchRequest,
    ProgressRequest,
    ReplayState,
    SnapshotRequest,
    Told,
    Turns,
    TurnsRequest,
)
from shared.rl.draws import generator
from shared.service import TICK_S, Service, Stopped, service

VERSION_PATIENCE_S = 60.0
"""How long an episode of an unknown version is sent back to be sent again, at least."""
HEARD_S = 10.0
"""A learner that was heard no longer ago than this tells which versions there are."""


def run(config: Config, folder: Path, life: str) -> None:
    """Keep the replay memory until stopped."""
    gather_heap()
    identity = f"{config.run.name}/{config.run.seed}"
    storage = Storage(folder / "replay", config.memory, identity)
    try:
        with service("replay", MAIN, config, life=life, halts=folder) as me:
            Intake(me, storage, folder).run()
    finally:
        storage.close()


class Intake:
    """The thread that commits episodes; starts and ends the other two."""

    def __init__(self, me: Service, storage: Storage, folder: Path) -> None:
        self._me, self._storage = me, storage
        self._inbox: Inbox = me.bus.inbox()
        self._bulk: Inbox = me.bus.inbox()
        self._worker = TurnWorker(me, storage, folder, self._inbox.wake)
        self._counters = storage.counters()
        self._version = max(1, storage.newest_weights_version())
        self._doubted: dict[tuple[str, int], float] = {}
        """When a robot first sent an episode of a version that is not known."""
        self._complaints = Complaints(me.log.warning)
        self.duplicates = 0
        self.refused = 0
        me.stop.on_set(self._inbox.wake)
        me.stop.on_set(self._bulk.wake)

    def run(self) -> None:
        """Serve until stopped."""
        for stream in (EPISODE, PROGRESS):
            self._inbox.serve(stream, "*")
        self._inbox.serve(TURNS)
        for stream in (CHANGES, SNAPSHOT, MINI_BATCH):
            self._bulk.serve(stream)
        bulk = threading.Thread(target=self._stream_all, name="bulk", daemon=True)
        self._worker.start()
        bulk.start()
        try:
            self._serve()
        finally:
            self._me.stop.set("finished")
            self._worker.join(4.0)
            bulk.join(4.0)

    def _serve(self) -> None:
        next_beat_s, shown = 0.0, None
        while not self._me.stop.is_set():
            self._inbox.wait(TICK_S)
            for request in self._inbox.requests():
                with request:
                    try:
                        self._answer(request)
                    except DiskFull as error:
                        self._complaints.tell("disk", str(error))
                        request.refuse(str(error))
            now_s, view = time.monotonic(), self._worker.view
            if view.position != shown or now_s >= next_beat_s:
                next_beat_s, shown = now_s + self._me.config.bus.heartbeat_s, view.position
                self._me.bus.publish(REPLAY_STATE, self._state())

    def _answer(self, request: Request) -> None:
        message = request.message
        if isinstance(message, Episode):
            if message.weights_version <= self._known_version():
                request.reply(self._commit(message))
            elif self._exists(message, time.monotonic()):
                request.refuse(f"weights version {message.weights_version} is not known here yet")
            else:
                reason = f"weights_version: the learner has made no {message.weights_version}"
                request.reply(self._refusal(message, reason))
        elif isinstance(message, ProgressRequest):
            request.reply(progress_of(self._counters, self._me.config.memory, message.robot))
        elif isinstance(message, TurnsRequest):
            request.reply(Turns(turns=self._storage.turns(message.since, message.limit)))

    def _known_version(self) -> int:
        """Newest weights version that exists: a turn would wait for ever for one that does not."""
        newest, _ = self._worker.weights.newest
        self._version = max(self._version, newest)
        return self._version

    def _exists(self, episode: Episode, now_s: float) -> bool:
        """Whether the version of an episode may exist, though not known: for a while any may."""
        robot = (episode.robot, episode.weights_version)
        if robot not in self._doubted and len(self._doubted) >= MAX_ROBOTS:
            self._doubted.clear()
        since_s = self._doubted.setdefault(robot, now_s)
        announced, heard_s = self._worker.weights.heard
        contradicted = announced < episode.weights_version and now_s - heard_s < HEARD_S
        return now_s - since_s < VERSION_PATIENCE_S or not contradicted

    def _refusal(self, episode: Episode, reason: str) -> EpisodeAck:
        """Refuse a submission for good. The log has a line for each kind of reason and minute."""
        self.refused += 1
        what = f"{episode.robot}/{episode.life}/{episode.number}"
        self._complaints.tell(reason.partition(":")[0], f"episode {what} is refused: {reason}")
        return EpisodeAck(accepted=False, reason=reason)

    def _commit(self, episode: Episode) -> EpisodeAck:
        """Store one submission; when the answer goes out, it is on disk."""
        try:
            accepted = self._storage.commit(episode)
        except Refused as error:
            return self._refusal(episode, str(error))
        self._counters = accepted.counters
        self.duplicates += int(accepted.duplicate)
        self._worker.submitted()
        return EpisodeAck(
            accepted=True,
            duplicate=accepted.duplicate,
            commit=accepted.commit.commit,
            episode=accepted.commit.episode or self._counters.episode,
            stored=accepted.commit.stored,
            progress=progress_of(self._counters, self._me.config.memory, episode.robot),
        )

    def _state(self) -> ReplayState:
        view, counters, memory = self._worker.view, self._counters, self._me.config.memory
        return ReplayState(
            id="main",
            life=self._me.life,
            change=view.position.change,
            commit=counters.commit,
            episode=counters.episode,
            turn=view.position.turn,
            turn_change=view.position.turn_change,
            lineage=view.position.turn_lineage,
            size=sum(view.by_action),
            capacity=view.position.capacity,
            filling=filling(counters, memory),
            by_action=view.by_action,
            retention=tuple(Told(name=name, value=n) for name, n in view.retention.items()),
            weights_version=view.weights_version,
            known_version=self._known_version(),
            activity=view.activity,
            progress=view.progress,
            fitness_mean_100=view.fitness_mean,
            duplicates=self.duplicates,
            refused=self.refused,
            undecodable=self._inbox.refused.total() + self._bulk.refused.total(),
            **_totals(counters),
        )

    def _stream_all(self) -> None:
        """The work of the bulk thread."""
        while not self._me.stop.is_set():
            self._bulk.wait(TICK_S)
            for request in self._bulk.requests():
                with request:
                    for part in self._parts(request.message):
                        request.reply(part)
                        if self._me.stop.is_set():
                            raise Stopped("a transfer")

    def _parts(self, message: Message) -> Iterable[Message]:
        """What answers a request for much."""
        feed = self._storage.feed
        if isinstance(message, ChangesRequest):
            return feed.changes(message.since, message.upto, message.lineage)
        if isinstance(message, SnapshotRequest):
            return feed.snapshot()
        if isinstance(message, MiniBatchRequest):
            draw = generator(self._me.config.run.seed, "foreign mini-batch", message.key)
            return [feed.mini_batch(message.size, draw)]
        return []


def _totals(counters: Counters) -> dict[str, int]:
    names = "bumps laps_left laps_right actions dropped_samples dropped_episodes"
    return {name: getattr(counters, name) for name in names.split()}
