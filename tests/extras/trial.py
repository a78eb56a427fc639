"""Does every extra, installed from the wheel beside nothing else, start what it is for?

    python -m tests.extras.trial [EXTRA ...]

Makes an environment for each extra and Python that is at hand, installs the wheel with the pinned
versions, and runs what the extra is for. Prints a line each, and what could not be tried.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.waiting import wait_until
from services.launcher.up import free_endpoint

ROOT = Path(__file__).parents[2]
DEADLINE_S = 90.0
NEWER = ("3.12", "3.13")
WITH_TORCH = {"actor", "replay", "learner", "record", "experiments", "openvino", "all"}
"""Not tried with the newer Pythons: their builds of torch would have to be downloaded."""


class Environment:
    """A virtual environment with the wheel and one extra, and a folder to work in."""

    def __init__(self, folder: Path, python: str, wheel: Path, extra: str) -> None:
        self.folder, self.bin = folder, folder / "venv" / "bin"
        self.endpoint = free_endpoint()
        subprocess.run([python, "-m", "venv", "--without-pip", folder / "venv"], check=True)
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-qqq", "--python"]
        constraints = ["--no-compile", "--constraint", str(ROOT / "constraints.txt")]
        what = f"corridor[{extra}] @ {wheel.as_uri()}"
        subprocess.run([*pip, self.bin / "python", "install", *constraints, what], check=True)

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start a command of the environment's `corridor`."""
        return subprocess.Popen(
            [self.bin / "corridor", *words],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *words: str) -> tuple[int, str]:
        """Run a command to its end: exit code and what it said."""
        with self.start(*words) as process:
            said, _ = process.communicate(timeout=DEADLINE_S)
        return process.returncode, said

    def starts(self, service: str, *options: str) -> None:
        """A service announces itself at a router, and ends cleanly. Raises AssertionError."""
        router = self.start("router", "--listen", self.endpoint)
        process = self.start(service, "--endpoint", self.endpoint, *options)
        try:
            look = ("status", "--endpoint", self.endpoint, "--require", service)
            wait_until(
                lambda: self.run(*look)[0] == 0 or process.poll() is not None,
                DEADLINE_S,
                f"{service} answers",
            )
            assert process.poll() is None, process.communicate()[0]
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0, process.communicate()[0]
        finally:
            for child in (process, router):
                child.kill()
                child.communicate()


def _service(name: str, *options: str) -> Callable[[Environment], None]:
    return lambda environment: environment.starts(name, *options)


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
    router = environment.start("router", "--listen", environment.endpoint)
    place = ("--endpoint", environment.endpoint)
    (environment.folder / "config.toml").write_text(environment.run("config")[1])
    process = environment.start("record", "--out", "a.mcap", "--config", "config.toml", *place)
    try:
        file = environment.folder / "a.mcap"
        wait_until(lambda: file.exists() or process.poll() is not None, DEADLINE_S, "a recording")
        assert process.poll() is None, process.communicate()[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0, process.communicate()[0]
    finally:
        for child in (process, router):
            child.kill()
            child.communicate()


UNREACHABLE = "127.0.0.1:9"
PURPOSES: dict[str, Callable[[Environment], None]] = {
    "driver": _without_services,
    "sim": _service("driver"),
    "robotino": _service(
        "driver", "--preset", "robotino", "--set", f"robot.robotino.address={UNREACHABLE}"
    ),
    "ros2": _command("driver", "--help"),
    "record": _record,
    "actor": _service("actor"),
    "replay": _service("replay"),
    "learner": _service("learner"),
    "secure": _command("secure", "init", "--folder", "secure"),
    "experiments": _command("experiment", "--describe", "plus-rmm"),
    "all": _command("doctor"),
}
"""What each extra is for."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Try them; returns 0 if all that could be tried work."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extras", nargs="*", choices=[[], *PURPOSES])
    chosen = parser.parse_args(arguments).extras or list(PURPOSES)
    failed = 0
    with tempfile.TemporaryDirectory() as place:
        wheel = _wheel(Path(place))
        for version, python in (("3.11", sys.executable), *((v, _python(v)) for v in NEWER)):
            if not python:
                print(f"Python {version}: NOT TRIED, there is none at hand")
                continue
            for extra in chosen:
                if version != "3.11" and (extra in WITH_TORCH or extra == "sim"):
                    continue
                failed += not _try(
                    Path(place) / f"{version}-{extra}", version, python, wheel, extra
                )
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
