"""Where a run is up on this machine, found with the standard library alone, so that it is quick.

A run folder is in use while `corridor up` holds the lock on its `lock` file; the kernel lets go of
the lock when the process ends, however it ends. Beside it, the file `endpoint` tells where the
router of that run listens and, in its second line, which folder of credentials it uses.
"""

import fcntl
import time
from pathlib import Path

RUNS = Path("runs")
WRITTEN_S = 180.0


def try_lock(descriptor: int, kind: int) -> bool:
    """Take a lock (`fcntl.LOCK_SH` or `LOCK_EX`) if nobody is in the way; whether it was taken."""
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_up(folder: Path) -> bool:
    """Whether a `corridor up` holds this run folder now."""
    try:
        with (folder / "lock").open() as stream:
            return not try_lock(stream.fileno(), fcntl.LOCK_SH)
    except OSError:
        return False


def in_use(folder: Path) -> bool:
    """Whether a `corridor up`, a service alone or an experiment works in this run folder now.

    Trying the lock of a service would refuse one that starts. An experiment writes every minute.
    """
    locks, files = Path("/proc/locks"), [*(folder / "roles").glob("*.lock")]
    held = locks.read_text() if locks.exists() else ""
    young = not files and time.time() - folder.stat().st_mtime < WRITTEN_S
    return is_up(folder) or young or any(f":{path.stat().st_ino} " in held for path in files)


def those_up() -> list[Path]:
    """The run folders below `runs/` that are up."""
    return [folder for folder in sorted(RUNS.glob("*")) if is_up(folder)]


def used(folder: Path) -> tuple[str, str] | None:
    """Endpoint and credentials that a run uses now; None: it is not up.

    What a killed supervisor left behind means nothing.
    """
    if not is_up(folder):
        return None
    try:
        lines = [*(folder / "endpoint").read_text().splitlines(), "", ""]
    except FileNotFoundError:
        return None
    return lines[0], lines[1]
