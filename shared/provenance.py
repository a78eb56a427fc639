"""What a run, a network or a measurement was made with: commit, processor, versions, robot."""

import hashlib
import json
import os
import platform
import shutil
import subprocess
from importlib import metadata
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from shared.config import Config, NetworkConfig, RobotConfig
from shared.facts import ACTIONS, IMAGE_SHAPE
from shared.rl.preprocess import PREPROCESS_VERSION

BUNDLE, BUNDLE_FORMAT = "bundle", 1
"""Where the metadata of a file of weights have its `Bundle` as JSON."""
ROOT = Path(__file__).parents[1]
RECORDED = (":!docs", ":!benchmarks/results.json", ":!benchmarks/results.md")
"""Text, and what measuring writes: no change to what is measured."""


class Bundle(BaseModel):
    """What a network was trained for and by what. Every file of weights or checkpoint has it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int = BUNDLE_FORMAT
    preprocessing: int = PREPROCESS_VERSION
    """Of its pictures."""
    image: tuple[int, int] = Field(default=IMAGE_SHAPE, description="Height and width in pixels.")
    actions: tuple[str, ...] = tuple(action.name for action in ACTIONS)
    network: NetworkConfig
    robot: RobotConfig
    """The robot that it learnt on: what an action does, and what the camera sees."""
    provenance: dict[str, str | int | None]


def bundle(config: Config, **counts: int | None) -> Bundle:
    """What a network of this run is. counts: how far it has learnt."""
    run: dict[str, str | int | None] = {"run": config.run.name, "world": config.robot.world}
    provenance = {**run, "seed": config.run.seed, **counts}
    return Bundle(network=config.network, robot=config.robot, provenance=provenance)


def machine() -> dict[str, str]:
    """Processor, cores and versions here, as `run.json` and tables of benchmarks name them."""
    return {
        "cpu": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
        "torch": version_of("torch"),
        "commit": commit(),
    }


def machine_key(config: Config) -> str:
    """8 hex digits over what decides which arithmetic is the fastest one."""
    decides = {
        "machine": [_processor(), len(os.sched_getaffinity(0)), version_of("torch")],
        "network": config.network.model_dump(mode="json"),
        "numerics": config.numerics.model_dump(mode="json"),
        "learning": [config.learning.batch_size, config.learning.mode],
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]


def commit() -> str:
    """The commit measured, with a plus when tracked files differ from it."""
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        return "unknown"

    def said(*words: str) -> str:
        done = subprocess.run([git, *words], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    changed = said("status", "--porcelain", "--untracked-files=no", "--", ".", *RECORDED)
    return said("rev-parse", "--short", "HEAD") + ("+" if changed else "")


def version_of(package: str) -> str:
    """The version that is installed, found without importing it; empty where there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.split(":")[1].strip()
    return platform.processor() or platform.machine()
