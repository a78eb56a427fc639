"""What a robot's own computer needs: size of `pip install corridor[robotino]`, and time to start.

Installs into a fresh virtual environment (through this machine's pip), checks that the driver is
there without torch, simulator and the libraries of experiments, and starts it against an address
where nothing answers: how long until its first line. The last line is one JSON object.

    python -m benchmarks.driver_install [--extra ros2]
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from shared.provenance import ROOT, machine

FOREIGN = ("torch", "pybullet", "cv2", "gymnasium", "matplotlib", "openvino")
NOWHERE = {
    "robotino": ("robot.kind=robotino", "robot.robotino.address=127.0.0.1:9"),
    "ros2": ("robot.kind=ros2", "robot.ros2.endpoint=tcp/127.0.0.1:9"),
}
PATIENCE_S = 0.05
"""How long the driver is told to wait for the robot: what is measured is its start."""
LIMIT_MB, LIMIT_S = 250.0, 3.0
ROUNDS = 7


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Raw)
    parser.add_argument("--extra", choices=list(NOWHERE), default="robotino")
    extra = parser.parse_args(arguments).extra
    with tempfile.TemporaryDirectory() as name:
        result = measure(Path(name), extra)
    print(json.dumps(result))
    return 0 if result["met"] else 1


class _Raw(argparse.RawDescriptionHelpFormatter):
    """Help as it is written above."""


def measure(folder: Path, extra: str) -> dict[str, object]:
    """Install and start; all figures."""
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    empty_mb = megabytes(venv)
    install(folder / "project", venv, extra)
    size_mb = megabytes(venv) - empty_mb
    largest = sorted(((megabytes(p), p.name) for p in packages(venv)), reverse=True)[:8]
    found = importable(venv)
    starts = [start(venv, folder, extra) for _ in range(ROUNDS + 1)][1:]  # the first reads disks
    starts_s, cpu_s = [wall_s for wall_s, _ in starts], [cpu_s for _, cpu_s in starts]
    print(f"corridor[{extra}]: {size_mb:.0f} MB beyond an empty environment of {empty_mb:.0f} MB")
    for mb, name in largest:
        print(f"    {mb:6.1f} MB  {name}")
    print(f"first line after {median(starts_s):.2f} s ({min(starts_s):.2f} to {max(starts_s):.2f})")
    print(f"of these {median(cpu_s):.2f} s on a processor, the rest waiting for one")
    return {
        "benchmark": "driver_install",
        "extra": extra,
        "size_mb": round(size_mb, 1),
        "empty_mb": round(empty_mb, 1),
        "start_s": round(median(starts_s), 3),
        "start_min_s": round(min(starts_s), 3),
        "start_max_s": round(max(starts_s), 3),
        "start_cpu_s": round(median(cpu_s), 3),
        "rounds": ROUNDS,
        "foreign": found,
        "limits": {"size_mb": LIMIT_MB, "start_s": LIMIT_S},
        "met": size_mb < LIMIT_MB and median(starts_s) < LIMIT_S and not found,
        "machine": machine(),
    }


def install(project: Path, venv: Path, extra: str) -> None:
    """Install a copy of the project: pip leaves files beside what it builds."""
    project.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, project)
    for name in ("shared", "services", "experiments"):
        shutil.copytree(ROOT / name, project / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [venv / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check"]
    pins = ["--constraint", ROOT / "constraints.txt"]
    subprocess.run([*command, *pins, f"{project}[{extra}]"], check=True)


def start(venv: Path, folder: Path, extra: str) -> tuple[float, float]:
    """Seconds until the driver, which finds no robot, says its first line, and of a processor."""
    settings = ["robot.timing=realtime", f"robot.hardware.open_timeout_s={PATIENCE_S}"]
    options = [word for item in (*settings, *NOWHERE[extra]) for word in ("--set", item)]
    before_s, used_s = time.perf_counter(), children_s()
    with subprocess.Popen(
        [venv / "bin" / "corridor", "driver", *options, "--run-dir", folder / "run"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        passed_s = time.perf_counter() - before_s
        process.kill()
    assert "driver" in line, f"expected a line of the driver, got {line!r}"
    return passed_s, children_s() - used_s


def children_s() -> float:
    """Processor time of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def importable(venv: Path) -> list[str]:
    """Which of the foreign modules the environment has."""
    code = f"from importlib.util import find_spec; print(*filter(find_spec, {list(FOREIGN)}))"
    done = subprocess.run(
        [venv / "bin" / "python", "-c", code], check=True, capture_output=True, text=True
    )
    return done.stdout.split()


def packages(venv: Path) -> list[Path]:
    """Everything installed, as folders and files."""
    return list((venv / "lib" / "python3.11" / "site-packages").iterdir())


def megabytes(path: Path) -> float:
    """Size on disk, in units of 10**6 bytes."""
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    return sum(file.lstat().st_blocks * 512 for file in files) / 1e6


if __name__ == "__main__":
    sys.exit(main())
