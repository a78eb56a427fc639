"""The replay memory to look at, beside replay or after it: one thread of the page reads its files.

Images stay on disk until they are looked at. Nothing here needs torch; see `elsewhere`.
"""

import asyncio
from base64 import b64encode
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from threading import Timer
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from services.page import elsewhere
from services.replay.tables import MARKS, Position, Tables, Txn, key_of, unpack
from shared import settings
from shared.errors import CorridorError, StateError
from shared.facts import ACTION_COUNT
from shared.rl.memory import Images, ReplayMemory

PAGE, NEIGHBOURS, AGES = 48, 12, 8
"""Images of a page, neighbours of a sample, bars of the ages."""
CHILD_S, IDLE_S = 60.0, 120.0
"""How long torch may take, and after how long without a question it goes."""
Rows = npt.NDArray[np.void]


class Query(BaseModel):
    """What of the memory is wanted. An age is in episodes."""

    model_config = ConfigDict(extra="forbid")

    id: int = 0
    action: Annotated[int, Field(ge=0, lt=ACTION_COUNT)] | None = None
    world: Annotated[str, Field(max_length=64)] | None = None
    candidate: bool | None = None
    least: float = -1.0
    most: float = 1.0
    youngest: int = 0
    oldest: int = 2**32
    bits: Annotated[int, Field(ge=0, le=120)] | None = None
    """Only what a search with this threshold would mark."""
    page: Annotated[int, Field(ge=0, le=100_000)] = 0


Answer = Callable[[Query], dict[str, Any]]


class Catalogue(ReplayMemory):
    """A memory without its images."""

    def _take_slots(self, count: int) -> npt.NDArray[np.uint32]:
        self._free.clear()
        return np.zeros(count, np.uint32)

    def _write(self, slots: npt.NDArray[np.uint32], images: Images) -> None:
        pass


class Browser:
    """Answers questions about the memory of a run, one after the other.

    run: the folder of the run; None: it is on another machine.
    """

    def __init__(self, run: Path | None) -> None:
        self._run = run or Path()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="memory")
        self._tables: Tables | None = None
        self._catalogue, self._position = Catalogue(1), Position(-1, 0, 0, 0, 1)
        self._child: ProcessPoolExecutor | None = None
        self._timer: Timer | None = None
        self._marked: dict[tuple[int, int], npt.NDArray[np.bool_]] = {}
        self.answers: tuple[Answer, ...] = (
            *(self.overview, self.samples, self.sample, self.prediction, self.discard),
        )

    async def ask(self, answer: Answer, query: dict[str, Any]) -> dict[str, Any]:
        """The answer, from the thread that owns the catalogue. Raises CorridorError, KeyError."""
        wanted, loop = Query.model_validate(query), asyncio.get_running_loop()
        return await loop.run_in_executor(self._pool, answer, wanted)

    def overview(self, _: Query) -> dict[str, Any]:
        """What is in the memory, counted."""
        memory = self._read()
        rows, marked, turn = memory.rows, memory.rows["candidate"], self._position.turn
        worlds = np.bincount(rows["world"], minlength=len(memory.worlds))
        ages, edges = np.histogram(turn - rows["episode"][rows["episode"] > 0].astype(int), AGES)
        config = settings.read_folder(self._run).memory
        return {
            **{"size": len(memory), "capacity": memory.capacity, "turn": turn},
            "by_action": memory.by_action(),
            "candidates": np.bincount(rows["action"][marked], minlength=ACTION_COUNT).tolist(),
            "worlds": dict(zip(memory.worlds, worlds.tolist(), strict=True)),
            "ages": [edges.round().tolist(), ages.tolist()],
            "fill": int(np.count_nonzero(rows["episode"] == 0)),
            "described": int(np.count_nonzero(rows["described_by"])),
            "threshold_percent": memory.kept.get("threshold_percent", config.threshold_percent),
            "strategy": config.strategy,
        }

    def samples(self, query: Query) -> dict[str, Any]:
        """A page of the samples that fit, the newest first."""
        memory = self._read()
        rows, age = memory.rows, self._position.turn - memory.rows["episode"].astype(int)
        fits = (rows["reward"] >= query.least) & (rows["reward"] <= query.most)
        fits &= (age >= query.youngest) & (age <= query.oldest)
        for name, wanted in (("action", query.action), ("candidate", query.candidate)):
            fits &= True if wanted is None else rows[name] == wanted
        if query.world is not None:
            known = memory.worlds.index(query.world) if query.world in memory.worlds else -1
            fits &= rows["world"] == known
        if query.bits is not None:
            fits &= self._would_mark(memory, query.bits)
        ranks = np.flatnonzero(fits)[::-1]
        shown = rows[ranks[PAGE * query.page : PAGE * (query.page + 1)]]
        counts = np.bincount(rows["action"][ranks], minlength=ACTION_COUNT).tolist()
        return {"count": len(ranks), "by_action": counts, "samples": self._shown(shown)}

    def sample(self, query: Query) -> dict[str, Any]:
        """Everything that is known of one sample, also of one that was just discarded."""
        memory = self._read()
        with self._open().env.begin() as txn:
            then, images = self._open().rows(txn, [query.id])
            record = unpack(txn.get(key_of(int(then[0]["commit"])), db=self._open().db["commits"]))
            there = query.id in memory.ids
            gone = self._removed(txn)
            now = memory.rows[memory.ranks(then["id"])] if there else gone[gone["id"] == query.id]
        row = then[0]
        told: dict[str, Any] = {
            "image": b64encode(images[0]).decode(),
            "there": there,
            "world": memory.worlds[row["world"]],
            "reward_observed": float(row["reward"]),
            "reward": float(now[0]["reward"]) if there else None,
            "pose": [round(float(row[name]), 3) for name in ("x_m", "y_m", "heading_rad")],
        }
        names = ("action", "episode", "robot_episode", "step", "version")
        told |= {name: row[name].item() for name in names}
        told |= {n: record[n] for n in ("robot", "life", "robot_life", "ended")}
        if len(now) and now[0]["described_by"]:
            told["descriptor"] = np.unpackbits(now[0]["descriptor"]).tolist()
            told |= {"candidate": bool(now[0]["candidate"]), "forced": bool(now[0]["forced"])}
            near, bits = nearest(now[0], row["action"], memory.rows, NEIGHBOURS)
            found = zip(self._shown(memory.rows[near]), bits.tolist(), strict=True)
            told["neighbours"] = [{**shown, "bits": count} for shown, count in found]
        return told

    def prediction(self, query: Query) -> dict[str, Any]:
        """What the newest target network predicts for a sample's image."""
        with self._open().env.begin() as txn:
            images = self._open().rows(txn, [query.id])[1]
        values, episode = self._elsewhere(elsewhere.predict, self._run, images)
        return {"values": values[0], "episode": episode}

    def discard(self, query: Query) -> dict[str, Any]:
        """A page of what the newest discard removed, each with what it looked like, and why."""
        memory = self._read()
        with self._open().env.begin() as txn:
            gone = self._removed(txn)
            page = gone[PAGE * query.page : PAGE * (query.page + 1)]
            kept = self._open().rows(txn, [int(i) for i in page["id"]])[0] if len(page) else page
        told = self._shown(kept)
        for shown, mark, row in zip(told, page, kept, strict=True):
            near, bits = nearest(mark, row["action"], memory.rows, 1, newer=True)
            like = self._shown(memory.rows[near])
            shown |= {"why": _why(mark)}
            shown["like"] = {**like[0], "bits": int(bits[0])} if like else None
        reasons = [_why(mark) for mark in gone]
        counts = {why: reasons.count(why) for why in ("alike", "decree", "age")}
        return {"count": len(gone), "reasons": counts, "samples": told}

    def _open(self) -> Tables:
        if self._tables is None:
            self._tables = Tables(self._run / "replay", readonly=True)
        return self._tables

    def _read(self) -> Catalogue:
        """The catalogue as of the newest turn."""
        tables = self._open()
        with tables.env.begin() as txn:
            if tables.meta(txn, "position") is None:
                raise StateError("the memory is empty")
            newest = tables.position(txn)
        if newest != self._position:
            self._position = tables.update(self._catalogue)
        return self._catalogue

    def _removed(self, txn: Txn) -> Rows:
        """Marks of what the newest discard removed, as far as its images are still there."""
        found = self._open().column(txn, "removed", MARKS)
        images = self._open().db["images"]
        there = (txn.get(key_of(int(i)), db=images) is not None for i in found["id"])
        return found[np.fromiter(there, np.bool_)]

    def _shown(self, rows: Rows) -> list[dict[str, Any]]:
        """Rows with their images, ready for JSON."""
        if not len(rows):
            return []
        with self._open().env.begin() as txn:
            images = self._open().rows(txn, [int(i) for i in rows["id"]])[1]
        names = ("id", "action", "reward", "candidate", "episode")
        return [
            {name: row[name].item() for name in names} | {"image": b64encode(image).decode()}
            for row, image in zip(rows, images, strict=True)
        ]

    def _would_mark(self, memory: Catalogue, bits: int) -> npt.NDArray[np.bool_]:
        """What a search with this threshold would mark of what has a descriptor: bool [n]."""
        key = (self._position.change, bits)
        if key not in self._marked:
            found, described = np.zeros(len(memory), np.bool_), memory.rows["described_by"] > 0
            own = memory.rows[described]
            what = own["action"].copy(), own["descriptor"].copy(), bits
            found[described] = self._elsewhere(elsewhere.marked, self._run, *what)
            self._marked = {key: found}
        return self._marked[key]

    def _elsewhere(self, work: Callable[..., Any], *values: Any) -> Any:
        """The result of work in the process with torch, which goes when nobody asks it."""
        if self._timer:
            self._timer.cancel()
        if self._child is None:
            spawn = get_context("spawn")
            self._child = ProcessPoolExecutor(1, mp_context=spawn, initializer=elsewhere.begin)
        try:
            return self._child.submit(work, *values).result(CHILD_S)
        except ModuleNotFoundError as error:
            raise CorridorError(f"this needs corridor[actor]: {error}") from error
        except (BrokenExecutor, TimeoutError) as error:
            self.end()
            raise CorridorError(f"the process with torch ended: {error!r}") from error
        finally:
            self._timer = Timer(IDLE_S, lambda: self._pool.submit(self.end))
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        """Let the process with torch go, if there is one."""
        if self._child is not None:
            self._child.shutdown(wait=False, cancel_futures=True)
            self._child = None


def _why(mark: np.void) -> str:
    return "decree" if mark["forced"] else "alike" if mark["candidate"] else "age"


def nearest(
    mark: np.void, action: int, rows: Rows, count: int, *, newer: bool = False
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Places of the samples of the same action whose descriptors differ in the fewest bits.

    Only descriptors of one kind and version can be compared. Of equally near ones the newest comes
    first. Returns places and bits.
    """
    alike = (rows["action"] == action) & (rows["described_by"] == mark["described_by"])
    alike &= (rows["id"] > mark["id"]) if newer else (rows["id"] != mark["id"])
    alike &= mark["described_by"] > 0
    own = np.flatnonzero(alike)[::-1]
    bits = np.bitwise_count(rows["descriptor"][own] ^ mark["descriptor"]).sum(axis=1)
    chosen = np.argsort(bits, kind="stable")[:count]
    return own[chosen], bits[chosen]
