"""The system in containers, for real: `make compose-test`.

Builds the images, brings the simulated robot up with our own router, waits for twenty episodes,
kills every container once, and checks that each comes back, that episodes go on, and that no
acknowledged one is lost or doubled. Takes everything down again, also after a failure.

Needs a Docker engine and Docker Compose, either `docker compose` or docker-compose 1.29. Where the
base image cannot be pulled, it is made from Debian packages (deploy/make-base-image.sh, as root).
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.waiting import wait_until

T = TypeVar("T")
ROOT = Path(__file__).parents[2]
DOCKER = shutil.which("docker") or "docker"
FILES = ("docker-compose.yml", "docker-compose.own-router.yml", "tests/compose/small.yml")
PROJECT = "corridor-compose-test"
BASE_IMAGE = "python:3.11-slim-bookworm"
RUN = "compose-test"
SERVICES = ("router", "driver", "actor", "replay", "learner")
IMAGES = ("router", "driver-demo", "actor", "replay", "learner")
EPISODES, MORE = 20, 5
"""Episodes before the first kill, and after each."""
PATIENCE_S = 600.0
"""Longest wait for any one thing; machines that do other things are slow."""
BUILD_S = 3600.0
"""Longest time to make base image and images, which may have to fetch gigabytes."""
SETTINGS = {
    "BASE_IMAGE": BASE_IMAGE,
    "CORRIDOR_RUN__NAME": RUN,
    "CORRIDOR_RUN__SEED": "7",
    "PRESET": "demo",
    "SUBNET": "10.213.8.0/24",  # beside a system that runs already
}
KILL = "import os, signal; os.kill(-1, signal.SIGKILL)"
"""Every process of the container but its init, which then ends as after a crash. `docker kill`
would not do: Docker restarts nothing that it was told to kill."""


class Failed(Exception):
    """What was expected and what came, in one line."""


def has_compose_v2() -> bool:
    """Whether Docker is there and knows `docker compose`."""
    if shutil.which(DOCKER) is None:
        return False
    done = subprocess.run([DOCKER, "compose", "version"], capture_output=True, timeout=PATIENCE_S)
    return done.returncode == 0


class Trial:
    """One run of the system under Compose, and what was found out about it."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith(("CORRIDOR_", "COMPOSE_"))},
            **SETTINGS,
        }
        self._compose = [DOCKER, "compose"] if has_compose_v2() else ["docker-compose"]
        self.passed: list[str] = []

    # ---------------------------------------------------------------- commands

    def run(
        self, *command: str, check: bool = True, timeout_s: float = PATIENCE_S, shown: bool = False
    ) -> str:
        """Run a command to its end; returns what it printed, unless `shown`. Raises Failed."""
        try:
            done = subprocess.run(
                command,
                cwd=ROOT,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                capture_output=not shown,
                text=True,
                timeout=timeout_s,
            )
        except FileNotFoundError as error:
            raise Failed(f"missing: {command[0]}") from error
        except subprocess.TimeoutExpired as error:
            raise Failed(f"{' '.join(command)[:200]}: not done after {timeout_s:.0f} s") from error
        if check and done.returncode != 0:
            said = done.stderr or done.stdout or f"exit code {done.returncode}"
            raise Failed(f"{' '.join(command)[:200]}: {said[-2000:]}")
        return done.stdout or ""

    def show(self, *command: str) -> None:
        """Run a command and let it print; for what takes minutes."""
        self.run(*command, timeout_s=BUILD_S, shown=True)

    def compose(self, *arguments: str, check: bool = True) -> str:
        """Run a command of Compose on our project."""
        files = [word for name in FILES for word in ("-f", name)]
        return self.run(*self._compose, *files, "-p", PROJECT, *arguments, check=check)

    def container(self, service: str) -> dict[str, Any]:
        """What Docker knows of the container of a service. Raises Failed when there is none."""
        ident = self.compose("ps", "-a", "-q", service).strip()
        if not ident:
            raise Failed(f"{service} has no container")
        found: dict[str, Any] = json.loads(self.run(DOCKER, "inspect", ident))[0]
        return found

    def rows(self) -> list[dict[str, str]]:
        """The episodes that are through the whole loop so far, as replay wrote them down."""
        path = f"runs/{RUN}/episodes.csv"
        text = self.compose("exec", "-T", "replay", "cat", path, check=False)
        lines = text.splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]  # not one just being written
        return list(csv.DictReader(whole))

    # ---------------------------------------------------------------- waiting and telling

    def wait(self, condition: Callable[[], T | None], what: str) -> T:
        """Poll until the condition gives something. Raises Failed at the deadline."""
        try:
            found = wait_until(condition, PATIENCE_S, what, poll_s=1.0)
        except AssertionError as error:
            raise Failed(str(error)) from error
        assert found is not None
        return found

    def episodes(self, count: int) -> list[dict[str, str]]:
        """Wait for so many episodes; returns their rows."""

        def there() -> list[dict[str, str]] | None:
            rows = self.rows()
            return rows if len(rows) >= count else None

        return self.wait(there, f"{count} episodes")

    def tell(self, text: str) -> None:
        """One line with the time since the start."""
        sys.stdout.write(f"{time.monotonic() - self._start_s:7.1f} s  {text}\n")
        sys.stdout.flush()

    def found(self, text: str) -> None:
        """Note one check that holds."""
        self.passed.append(text)
        self.tell(f"ok: {text}")

    # ---------------------------------------------------------------- the trial

    def build(self) -> None:
        """Make every image, of robots that are not there too."""
        self.run(DOCKER, "info")
        if not self.run(DOCKER, "images", "-q", BASE_IMAGE).strip() and not self.pulled():
            self.tell("no image registry in reach: the base image is made of Debian packages")
            self.show("deploy/make-base-image.sh", BASE_IMAGE)
        self._environment["PYTHON"] = sys.executable
        files = [word for name in FILES for word in ("-f", name)]
        self.show("deploy/build-images.sh", *files, *SERVICES)
        self.found("images are built")
        for name, size in self.sizes().items():
            self.tell(f"    {name:24} {size / 1e6:6.0f} MB")

    def pulled(self) -> bool:
        """Whether a registry gave the base image."""
        try:
            done = subprocess.run([DOCKER, "pull", BASE_IMAGE], capture_output=True, timeout=300)
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    def sizes(self) -> dict[str, int]:
        """Bytes of every image."""
        names = [BASE_IMAGE, *(f"corridor-{name}" for name in IMAGES)]
        return {
            name: int(self.run(DOCKER, "image", "inspect", "-f", "{{.Size}}", name))
            for name in names
        }

    def up(self) -> None:
        """Bring everything up; the first episodes come."""
        self.compose("up", "-d", "--no-build", *SERVICES)
        self.tell("containers are up")
        self.episodes(EPISODES)
        self.found(f"{EPISODES} episodes")
        self.wait(self.all_healthy, "all containers healthy")
        self.found("all containers are healthy")

    def all_healthy(self) -> bool:
        """Whether the health check of every container says so."""
        return all(
            self.container(service)["State"]["Health"]["Status"] == "healthy"
            for service in SERVICES
        )

    def confined(self) -> None:
        """Containers cannot write, gain rights or be root."""
        for service in SERVICES:
            host = self.container(service)["HostConfig"]
            user = self.compose("exec", "-T", service, "id", "-u").strip()
            if user == "0" or not host["ReadonlyRootfs"] or host["CapDrop"] != ["ALL"]:
                raise Failed(
                    f"{service}: user {user}, {host['ReadonlyRootfs']=}, {host['CapDrop']=}"
                )
        self.found("containers run read-only, without capabilities, as nobody special")

    def kill(self, service: str) -> None:
        """Kill one container; it comes back, episodes go on, those before are still the same."""
        restarts = self.container(service)["RestartCount"]
        before = self.episodes(EPISODES)
        self.compose("exec", "-T", service, "python", "-c", KILL, check=False)

        def back() -> bool:
            found = self.container(service)
            return bool(found["RestartCount"] > restarts and found["State"]["Running"])

        self.wait(back, f"{service} back after its kill")
        after = self.episodes(len(before) + MORE)
        if after[: len(before)] != before:
            raise Failed(f"{service} killed: episodes that were there have changed or gone")
        self.found(f"{service} killed: back, {len(before)} episodes kept, {len(after)} now")

    def stop(self) -> None:
        """Stop everything; what was acknowledged is on disk, once."""
        before = self.rows()
        # The router last: a clean stop hands over what is open.
        for service in reversed(SERVICES):
            if service != "router":
                self.compose("stop", "-t", "60", service)
        self.compose("stop", "-t", "60", "router")
        codes = {service: self.container(service)["State"]["ExitCode"] for service in SERVICES}
        if any(codes.values()):
            raise Failed(f"expected exit code 0 of all when stopped, got {codes}")
        self.found("all stop cleanly when asked")
        code = (ROOT / "tests/compose/stored.py").read_text()
        text = self.compose(
            *("run", "--rm", "--no-deps", "-T", "--entrypoint", "python", "replay"),
            *("-c", code, f"runs/{RUN}"),
        )
        self.check_stored(json.loads(text.splitlines()[-1]), len(before))

    def check_stored(self, stored: dict[str, Any], seen: int) -> None:
        """Exactly once, numbered without a gap, at least as many as were seen."""
        submissions = [tuple(item) for item in stored["submissions"]]
        if len(set(submissions)) != len(submissions) or len(submissions) != stored["commits"]:
            raise Failed(f"a submission is stored twice or not at all: {stored}")
        if stored["episodes"] != list(range(1, stored["counted"] + 1)):
            raise Failed(f"expected episodes 1..{stored['counted']}, got {stored['episodes']}")
        if stored["counted"] < seen:
            raise Failed(f"{seen} episodes were announced, but {stored['counted']} are on disk")
        for life in {life for _, life, _ in submissions}:
            numbers = sorted(number for _, other, number in submissions if other == life)
            if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
                raise Failed(f"an episode of life {life} was acknowledged and lost: {numbers}")
        self.found(
            f"{stored['counted']} episodes on disk, none lost, none doubled "
            f"(open episodes dropped with their actors {stored['dropped_episodes']})"
        )

    def last_words(self) -> None:
        """What helps to find out why it failed."""
        for words in (("ps",), ("logs", "--no-color", "--tail", "40")):
            sys.stdout.write(self.compose(*words, check=False))

    def down(self) -> None:
        """Remove containers, network and volumes; images stay for the next time."""
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "20", check=False)


def main(arguments: Sequence[str]) -> int:
    """Run the trial; 0 when everything holds. `--no-build` takes the images that are there."""
    if shutil.which(DOCKER) is None:
        sys.stderr.write("compose-test: missing: docker\n")
        return 1
    trial = Trial()
    failure = ""
    try:
        if "--no-build" not in arguments:
            trial.build()
        trial.down()  # what an earlier trial may have left
        trial.up()
        trial.confined()
        for service in SERVICES:
            trial.kill(service)
        trial.stop()
    except Failed as error:
        failure = str(error)
        trial.tell(f"FAILED: {failure}")
        with suppress(Failed):
            trial.last_words()
    except KeyboardInterrupt:
        failure = "interrupted"
    finally:
        try:
            trial.down()
            trial.tell("everything is down")
        except Failed as error:
            failure = failure or str(error)
            trial.tell(f"FAILED to take everything down: {error}")
    sys.stdout.write(f"compose-test: {len(trial.passed)} passed, {int(bool(failure))} failed\n")
    return 1 if failure else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
