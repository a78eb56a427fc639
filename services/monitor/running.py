"""Holding the folder of a run that is up (`shared.place`), and how to reach a run."""

import fcntl
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from shared import settings
from shared.config import Config
from shared.errors import ConfigError
from shared.place import those_up, try_lock, used

LOOKING_S, ORPHANS_S = 1.0, 6.0
"""How long a taken lock is waited for while its owner lives, and after its death."""


@contextmanager
def locked(folder: Path) -> Iterator[int]:
    """Hold the run folder for this process; yields the descriptor that holds the lock.

    Children that inherit the descriptor hold the lock too: a run counts as up until the last
    process of it is gone, also after its supervisor was killed. Raises ConfigError when another
    `corridor up` holds it.
    """
    start_s = time.monotonic()
    with (folder / "lock").open("a+") as stream:
        while not try_lock(stream.fileno(), fcntl.LOCK_EX):
            stream.seek(0)
            owner = stream.read().strip()
            # Others may look at the lock for an instant, and orphans need a moment to end.
            patience_s = LOOKING_S if _is_process(owner) else ORPHANS_S
            if time.monotonic() - start_s > patience_s:
                raise ConfigError(
                    f"run folder {folder} is in use by `corridor up`, process {owner}"
                )
            time.sleep(0.05)
        stream.truncate(0)
        stream.write(f"{os.getpid()}\n")
        stream.flush()
        try:
            yield stream.fileno()
        finally:
            (folder / "endpoint").unlink(missing_ok=True)
            stream.truncate(0)


def _is_process(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except (ValueError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return True


def reach(
    run_dir: Path | None = None,
    run: str | None = None,
    endpoint: str | None = None,
    env: Mapping[str, str] | None = None,
    credentials: str | None = None,
) -> Config:
    """The configuration by which a running run is reached from outside.

    A given endpoint (option or environment) is taken as it is. Otherwise the run that is up in
    `run_dir`, or the only one in `runs/`, is meant; without one, the default endpoint. Raises
    ConfigError when several runs are up and none was chosen.
    """
    chosen = {"run.name": run, "bus.endpoint": endpoint, "bus.credentials": credentials}
    overrides = [f"{key}={settings.toml_value(v)}" for key, v in chosen.items() if v is not None]
    plain = settings.load(overrides=overrides, env=env)
    if endpoint is not None or "CORRIDOR_BUS__ENDPOINT" in (env or {}):
        return plain
    if run_dir is not None:
        return _of_folder(run_dir, overrides)
    up = those_up()
    if run is not None:
        up = [folder for folder in up if settings.read_folder(folder).run.name == run]
    if len(up) > 1:
        raise ConfigError(
            f"several runs are up, choose one by --run-dir: {', '.join(map(str, up))}"
        )
    return _of_folder(up[0], overrides) if up else plain


def _of_folder(folder: Path, overrides: list[str]) -> Config:
    """The stored configuration with the endpoint and the credentials the run uses now."""
    stored = settings.read_folder(folder)
    now = used(folder) or (stored.bus.endpoint, stored.bus.credentials)
    keys = ("bus.endpoint", "bus.credentials")
    there = [f"{key}={settings.toml_value(value)}" for key, value in zip(keys, now, strict=True)]
    overrides = [*there, "bus.shared_memory=false", *overrides]  # an order waits for no memory
    return settings.load(file=folder / settings.FILE_NAME, overrides=overrides)
