"""A run with two simulated robots, and Debian's Chromium in front of its page."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, BrowserContext, sync_playwright

from benchmarks.waiting import wait_until
from shared.place import used

CORRIDOR = [sys.executable, "-P", "-m", "services.cli"]
CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
SMALL = (
    "run.name=twins", "network.filters=8", "memory.capacity=300", "memory.equalise_every=3",
    "learning.batch_size=8", "learning.fit_every=3", "learning.fit_epochs=1",
    "episode.max_samples=60", "episode.horizon=20",
)  # fmt: skip
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}
PATIENCE_S = 90.0


class Run:
    """`corridor up` with a second robot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def address(self) -> str:
        """Where its page is."""
        return (self.folder / "page").read_text().strip()

    def pid(self, name: str) -> int:
        """The newest process of one child; 0 before there is one."""
        log = self.folder / "logs" / "up.log"
        rows = log.read_text().splitlines() if log.exists() else []
        started = f" {name} started as process "
        return [0, *(int(row.rsplit(" ", 1)[1]) for row in rows if started in row)][-1]

    def kill(self, name: str) -> None:
        """As by `kill -9`."""
        os.kill(self.pid(name), signal.SIGKILL)


def _start(log: Path, *words: str) -> subprocess.Popen[bytes]:
    with log.open("ab") as stream:
        command = [*CORRIDOR, *words]
        return subprocess.Popen(command, stdout=stream, stderr=stream, env=ENVIRONMENT)


@contextmanager
def running(folder: Path, *settings: str, episodes: int = 2) -> Iterator[Run]:
    """The run, once it has done some episodes; everything ends with the block."""
    sets = [f"--set={item}" for item in (*SMALL, *settings)]
    folder.mkdir(parents=True, exist_ok=True)
    log, run = folder.with_suffix(".log"), Run(folder)
    children = [_start(log, "up", "--run-dir", str(folder), *sets)]
    try:
        wait_until(lambda: used(folder) and run.pid("page"), PATIENCE_S, "the run is up")
        where = used(folder)
        assert where is not None
        config = ("--config", str(folder / "config.toml"), "--run-dir", str(folder))
        second = ("--set=robot.id=second", f"--set=bus.endpoint={where[0]}")
        children.append(_start(log, "driver", *config, *second))
        table = folder / "episodes.csv"

        def done() -> bool:
            return table.exists() and len(table.read_text().splitlines()) > episodes

        wait_until(done, 3 * PATIENCE_S, f"{episodes} episodes: {log}")
        yield run
    finally:
        for child in reversed(children):
            child.send_signal(signal.SIGTERM)
        for child in children:
            try:
                child.wait(20.0)
            except subprocess.TimeoutExpired:
                child.kill()


@contextmanager
def at_rest(folder: Path) -> Iterator[str]:
    """The page of a run that is over; yields its address."""
    log = folder.with_suffix(".rest.log")
    child = _start(log, "page", "--run-dir", str(folder))
    try:
        found = wait_until(lambda: re.search(r"http://\S+", log.read_text()), 30.0, "an address")
        assert found is not None
        yield found[0]
    finally:
        child.terminate()
        assert child.wait(20.0) == 0


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser that talks to nobody but who it is sent to."""
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def context(browser: Browser, width: int, scheme: str = "light") -> BrowserContext:
    """Windows of this width that like it light or dark."""
    size = {"width": width, "height": 900 if width > 600 else 844}
    return browser.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]


def installed() -> str:
    """Have a browser; why there is none, if so."""
    if shutil.which(CHROMIUM):
        return ""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for words in (("update",), ("install", "-y", "--no-install-recommends", "chromium")):
        try:
            done = subprocess.run(
                ["/usr/bin/apt-get", "-qq", *words],
                env=environment,
                capture_output=True,
                text=True,
                timeout=600,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"apt-get {words[0]}: {error}"
        if done.returncode:
            return f"apt-get {words[0]}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}"
    return "" if shutil.which(CHROMIUM) else "chromium was installed, but is not there"
