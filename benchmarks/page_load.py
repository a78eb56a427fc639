"""P16: what the web page costs: its memory, its share of a core, and what training loses beside it.

The demo runs with and without the page in turns. A browser is stood in for by a client that
acknowledges every update at once, so that it gets as many as the page ever sends: five a second.
Training is the steps of the learner per second while it fits.

    python -m benchmarks.page_load [--short | --check]
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from websockets.sync.client import connect

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.waiting import wait_until
from services.monitor.heartbeats import Reader
from shared.bus import Bus
from shared.config import BusConfig
from shared.errors import RouterMissing
from shared.place import used

LONG = True
RUN, PATIENCE_S = "page-load", 180.0
MEASURED_S = {"check": 10.0, "short": 60.0, "full": 120.0}
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Found:
    """One run: training, and the page beside it, if there was one."""

    steps_per_s: float
    rss_mb: float = 0.0
    core_percent: float = 0.0
    updates_per_s: float = 0.0
    disconnects: int = 0


class Client(threading.Thread):
    """A browser that paints in no time."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._address = re.sub(r"^http(.*/)#.*$", r"ws\1updates", address)
        self.updates, self.connections, self.done = 0, 0, threading.Event()

    def run(self) -> None:
        """Take updates until told to end; come again when the connection is lost."""
        while not self.done.is_set():
            self.connections += 1
            with connect(self._address) as socket:
                while not self.done.is_set():
                    number = json.loads(socket.recv(10.0))["number"]
                    socket.send(json.dumps({"seen": number}))
                    self.updates += 1


@contextmanager
def running(folder: Path, *options: str) -> Iterator[str]:
    """The demo; yields the endpoint of its router."""
    command = [sys.executable, "-P", "-m", "services.cli", "up", "--preset", "demo", *options]
    where = ("--run-dir", str(folder), "--set", f"run.name={RUN}")
    with subprocess.Popen([*command, *where], stdout=subprocess.DEVNULL) as child:
        try:
            place = wait_until(lambda: used(folder), PATIENCE_S, "the run is up")
            assert place is not None
            yield place[0]
        finally:
            child.send_signal(signal.SIGINT)


def spent_s(pid: int) -> float:
    """Seconds of processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def rss_mb(pid: int) -> float:
    """Memory of a process that is in RAM."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return int(found[1]) / 1e3 if found else 0.0


def connected(endpoint: str) -> Bus | None:
    """A client of the router, once it answers."""
    try:
        return Bus(BusConfig(endpoint=endpoint), RUN)
    except RouterMissing:
        return None


def training(endpoint: str, seconds: float) -> float:
    """Steps of the learner per second, of the time in which it fits, from the first fit on."""
    steps, spent, before = 0, 0.0, None
    found = wait_until(lambda: connected(endpoint), PATIENCE_S, "the router answers")
    assert found is not None
    with found as bus:
        reader = Reader(inbox := bus.inbox())

        def fits() -> bool:
            inbox.wait(0.1)
            reader.update()
            learner = reader.snapshot().learner
            return learner is not None and learner.message.activity == "fitting"

        wait_until(fits, PATIENCE_S, "the learner fits")
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            inbox.wait(1.0)
            at_s = time.monotonic()
            reader.update()
            learner = reader.snapshot().learner
            if learner is None or learner.age_s > 0.05 or learner.message.activity != "fitting":
                before = before if learner and learner.message.activity == "fitting" else None
                continue
            now = learner.message.train_steps + learner.message.fit_batch
            if before is not None and now > before[0]:
                steps, spent = steps + now - before[0], spent + at_s - before[1]
            before = now, at_s
    return steps / max(spent, 1e-9)


def look(folder: Path, seconds: float, *, page: bool) -> Found:
    """One run of the demo, with a page that a browser looks at, or without."""
    with running(folder, *([] if page else ["--no-page"])) as endpoint:
        if not page:
            return Found(training(endpoint, seconds))
        address = wait_until(
            lambda: (folder / "page").exists() and (folder / "page").read_text().strip(),
            PATIENCE_S,
            "the page",
        )
        rows = (folder / "logs" / "up.log").read_text().splitlines()
        pid = next(int(row.rsplit(" ", 1)[1]) for row in rows if " page started as " in row)
        client = Client(str(address))
        wait_until(lambda: spent_s(pid) > 0.5, PATIENCE_S, "the page has started")
        client.start()
        wait_until(lambda: client.updates > 10, PATIENCE_S, "updates")
        begun_s, spent_before_s, updates = time.monotonic(), spent_s(pid), client.updates
        steps_per_s = training(endpoint, seconds)
        passed_s = time.monotonic() - begun_s
        share = 100 * (spent_s(pid) - spent_before_s) / passed_s
        client.done.set()
        rate = (client.updates - updates) / passed_s
        return Found(steps_per_s, rss_mb(pid), share, rate, client.connections - 1)


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """A row for each run, and the bars P16a to P16c."""
    found: dict[bool, list[Found]] = {False: [], True: []}
    for number in range(1 if mode == "check" else rounds_of(mode, 2, 5)):
        for page in (True, False) if number % 2 else (False, True):
            with tempfile.TemporaryDirectory() as place:
                found[page].append(look(Path(place) / RUN, MEASURED_S[mode], page=page))
    rows: list[list[object]] = [
        [page, f.steps_per_s, f.rss_mb, f.core_percent, f.updates_per_s, f.disconnects]
        for page, runs in found.items()
        for f in runs
    ]
    seen, n = found[True], len(found[True])
    ours, plain = (median(f.steps_per_s for f in found[page]) for page in (True, False))
    rss, share = median(f.rss_mb for f in seen), median(f.core_percent for f in seen)
    checks = {
        "updates_per_s": median(f.updates_per_s for f in seen),
        "disconnects": float(sum(f.disconnects for f in seen)),
    }
    return rows, [
        Bar("P16a", rss, "MB", "lower", 200.0, 120.0, None, rss, n),
        Bar("P16b", share, "% of a core", "lower", 5.0, 3.0, None, share, n, checks),
        Bar("P16c", ours / plain, "x", "higher", 0.97, 0.99, plain, ours, n),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["page", "training steps/s", "RSS MB", "% of a core", "updates/s", "disconnects"]
    report("The web page beside a run", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
