"""Does every extra, installed from the wheel beside nothing else, start what it is for?

    python -m tests.extras.trial [EXTRA ...]

Makes an environment for each extra and Python that is at hand, installs the wheel with the pinned
versions, and runs what the extra is for. Prints a line each, and what could not be tried.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.request import urlopen

from benchmarks.waiting import wait_until
from services.launcher.up import free_endpoint

ROOT = Path(__file__).parents[2]
DEADLINE_S = 90.0
AT_ONCE = 2
"""Environments that are made and tried beside each other."""
NEWER = ("3.12", "3.13")
WITH_TORCH = {*("actor", "replay", "learner", "record", "experiments", "export", "openvino", "all")}
"""Not tried with the newer Pythons: their builds of torch would have to be downloaded."""


class Environment:
    """A virtual environment with the wheel and one extra, and a folder to work in."""

    def __init__(self, folder: Path, python: str, wheel: Path, extra: str) -> None:
        self.folder, self.bin = folder, folder / "venv" / "bin"
        self.endpoint = free_endpoint()
        self.place = ("--run", "trial", "--endpoint", self.endpoint)
        subprocess.run([python, "-m", "venv", "--without-pip", folder / "venv"], check=True)
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-qqq", "--python"]
        constraints = ["--no-compile", "--constraint", str(ROOT / "constraints.txt")]
        what = f"corridor[{extra}] @ {wheel.as_uri()}"
        subprocess.run([*pip, self.bin / "python", "install", *constraints, what], check=True)

    def run(self, *words: str) -> tuple[int, str]:
        """Run a command of the environment's `corridor`: exit code and what it said."""
        done = subprocess.run(
            [self.bin / "corridor", *words],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        return done.returncode, done.stdout

    @contextmanager
    def running(self, *words: str, until: Callable[[], bool]) -> Iterator[None]:
        """Run a command beside a router until something holds, and stop it.

        Raises AssertionError if it ends earlier, or not cleanly.
        """
        outputs = [self.folder / f"{name}.out" for name in ("router", words[0])]
        commands = [("router", "--listen", self.endpoint), (*words, *self.place)]
        with ExitStack() as stack:
            children = []
            for output, command in zip(outputs, commands, strict=True):
                stream = stack.enter_context(output.open("w"))
                child = subprocess.Popen(
                    [self.bin / "corridor", *command],
                    cwd=self.folder,
                    stdout=stream,
                    stderr=subprocess.STDOUT,
                )
                stack.callback(child.wait, DEADLINE_S)
                stack.callback(child.kill)
                children.append(child)
            process = children[1]
            wait_until(lambda: until() or process.poll() is not None, DEADLINE_S, words[0])
            assert process.poll() is None, outputs[1].read_text()
            yield
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0, outputs[1].read_text()


def _service(name: str, *options: str) -> Callable[[Environment], None]:
    """A service announces itself at a router, and ends cleanly."""

    def check(environment: Environment) -> None:
        look = ("status", *environment.place, "--require", name)
        with environment.running(name, *options, until=lambda: environment.run(*look)[0] == 0):
            pass

    return check


def _command(*words: str) -> Callable[[Environment], None]:
    def check(environment: Environment) -> None:
        code, said = environment.run(*words)
        assert code == 0, said

    return check


def _without_services(environment: Environment) -> None:
    """Configurations can be looked at, and what is missing for a run is named."""
    _command("config", "--preset", "robotino")(environment)
    code, said = environment.run("up", "--run", "x")
    assert code == 2, said
    assert "pip install 'corridor[" in said, said


def _record(environment: Environment) -> None:
    (environment.folder / "config.toml").write_text(environment.run("config")[1])
    file = environment.folder / "a.mcap"
    words = ("record", "--out", "a.mcap", "--config", "config.toml")
    with environment.running(*words, until=file.exists):
        pass


def _export(environment: Environment) -> None:
    """It comes as far as looking for the memory, with all its libraries."""
    code, said = environment.run("export", "memory", "nowhere", "--out", "a.parquet")
    assert code == 3, said
    assert "expected a replay memory" in said, said


class _Silent(BaseHTTPRequestHandler):
    def log_message(self, form: str, *args: object) -> None:
        """Say nothing."""


def _robotino(environment: Environment) -> None:
    """Its driver starts in front of a server that answers, and knows nothing that it is asked."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Silent) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"robot.robotino.address=127.0.0.1:{server.server_port}"
        _service("driver", "--preset", "robotino", "--set", address)(environment)
        server.shutdown()


def _page(environment: Environment) -> None:
    """It is served at the address that it prints."""
    said = environment.folder / "page.out"

    def served() -> bool:
        address = re.search(r"http://[\d.:]+/", said.read_text() if said.exists() else "")
        if address is None:
            return False
        with urlopen(f"{address[0]}metrics", timeout=5.0) as answer:  # noqa: S310
            return b"corridor_page_browsers" in answer.read()

    with environment.running("page", until=served):
        pass


def _ros2(environment: Environment) -> None:
    """Its driver starts in a network without a robot."""
    network = f"robot.ros2.endpoint={environment.endpoint}"
    _service("driver", "--preset", "turtlebot4", "--set", network)(environment)


PURPOSES: dict[str, Callable[[Environment], None]] = {
    "driver": _without_services,
    "sim": _service("driver"),
    "robotino": _robotino,
    "ros2": _ros2,
    "record": _record,
    "page": _page,
    "actor": _service("actor"),
    "replay": _service("replay"),
    "learner": _service("learner"),
    "secure": _command("secure", "init", "secure"),
    "export": _export,
    "experiments": _command("experiment", "--describe", "plus-rmm"),
    "all": _command("doctor"),
}
"""What each extra is for."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Try them; returns 0 if all that could be tried work."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extras", nargs="*", choices=[[], *PURPOSES])
    chosen = parser.parse_args(arguments).extras or list(PURPOSES)
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(AT_ONCE) as pool:
        wheel = _wheel(Path(place))
        tries = []
        for version, python in (("3.11", sys.executable), *((v, _python(v)) for v in NEWER)):
            if not python:
                print(f"Python {version}: NOT TRIED, there is none at hand")
                continue
            for extra in chosen:
                if version != "3.11" and (extra in WITH_TORCH or extra == "sim"):
                    continue
                folder = Path(place) / f"{version}-{extra}"
                tries.append(pool.submit(_try, folder, version, python, wheel, extra))
        failed = sum(not each.result() for each in tries)
        print(
            f"Python {', '.join(NEWER)}: NOT TRIED are sim (pybullet has no wheels there) and "
            f"{', '.join(sorted(WITH_TORCH))} (their builds of torch are not at hand)"
        )
    return 1 if failed else 0


def _try(folder: Path, version: str, python: str, wheel: Path, extra: str) -> bool:
    start_s = time.monotonic()
    folder.mkdir()
    try:
        PURPOSES[extra](Environment(folder, python, wheel, extra))
    except (AssertionError, subprocess.SubprocessError, OSError) as error:
        print(f"Python {version}, corridor[{extra}]: FAILED: {error}")
        return False
    finally:
        shutil.rmtree(folder)
    print(f"Python {version}, corridor[{extra}]: works, {time.monotonic() - start_s:.0f} s")
    return True


def _wheel(folder: Path) -> Path:
    """The wheel, built from a copy: a build leaves files behind that the next one takes along."""
    source = folder / "source"
    for name in ("shared", "services", "experiments"):
        shutil.copytree(ROOT / name, source / name)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-qqq"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, source], check=True)
    return next(folder.glob("corridor-*.whl"))


def _python(version: str) -> str:
    """An interpreter of this version that runs; empty without one."""
    found = shutil.which(f"python{version}") or ""
    places = [found, *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    for place in filter(None, places):
        done = subprocess.run([place, "-c", "import venv"], capture_output=True, check=False)
        if done.returncode == 0:
            return place
    return ""


if __name__ == "__main__":
    sys.exit(main())
