"""Restarts, final errors, the order of stopping, and that nothing is ever left running."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.terminals import full_pipe
from benchmarks.waiting import wait_until
from services.launcher.supervisor import ChildSpec, ChildStatus, Ending, Supervisor
from services.monitor.running import locked
from shared.errors import ConfigError
from shared.place import is_up

pytestmark = pytest.mark.system

SLEEP = "import time\nwhile True: time.sleep(1)\n"
STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" + SLEEP


def child(name: str, source: str, stage: int = 0, *, may_finish: bool = True) -> ChildSpec:
    return ChildSpec(name, (sys.executable, "-c", source), stage, may_finish)


def supervisor(folder: Path, *specs: ChildSpec) -> Supervisor:
    return Supervisor(specs, folder, dict(os.environ))


def ending(supervisor: Supervisor) -> Ending:
    return wait_until(supervisor.poll, 20, "a reason to end")


def status(supervisor: Supervisor, name: str) -> ChildStatus:
    supervisor.poll()
    return next(status for status in supervisor.statuses() if status.name == name)


def exists(pid: int) -> bool:
    """Whether a process runs; one that is only waiting to be reaped does not."""
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


def test_a_crashed_child_is_restarted_and_says_why(tmp_path: Path) -> None:
    source = f"""
import pathlib, sys
mark = pathlib.Path({str(tmp_path / "mark")!r})
if not mark.exists():
    mark.touch()
    sys.exit("2026-01-01 10:00:00,000 replay ERROR the first time")
{SLEEP}"""
    with supervisor(tmp_path, child("replay", source)) as running:
        wait_until(lambda: status(running, "replay").restarts == 1, 20, "a restart")
        assert status(running, "replay").note == "exit code 1: the first time"
        assert status(running, "replay").state == "running"


def test_a_killed_child_is_restarted(tmp_path: Path) -> None:
    with supervisor(tmp_path, child("actor", SLEEP)) as running:
        os.kill(running.pids()["actor"], signal.SIGKILL)
        wait_until(lambda: status(running, "actor").restarts == 1, 20, "a restart")
        assert status(running, "actor").note == "signal SIGKILL"


def test_a_child_that_is_given_up_is_killed_and_restarted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with supervisor(tmp_path, child("driver", SLEEP)) as running:
        os.kill(running.pids()["driver"], signal.SIGSTOP)
        running.give_up("driver", "no heartbeat for 31 s")
        wait_until(lambda: status(running, "driver").restarts == 1, 20, "a restart")
        assert status(running, "driver").note == "no heartbeat for 31 s"
    assert "driver: no heartbeat for 31 s: killed, restarted" in caplog.text


@pytest.mark.parametrize("code", [2, 3])
def test_a_final_error_ends_everything_with_its_line(tmp_path: Path, code: int) -> None:
    source = (
        f"import sys; print('memory.capacity: expected more', file=sys.stderr); sys.exit({code})"
    )
    with supervisor(tmp_path, child("actor", SLEEP), child("replay", source)) as running:
        assert ending(running) == Ending(code, "replay: memory.capacity: expected more")
        pid = running.pids()["actor"]
    assert not exists(pid)


def test_it_ends_when_all_that_may_finish_have_finished(tmp_path: Path) -> None:
    specs = (child("a", ""), child("b", ""), child("router", SLEEP, 3, may_finish=False))
    with supervisor(tmp_path, *specs) as running:
        assert ending(running) == Ending(0, "all services have stopped")
        states = [status.state for status in running.statuses()]
        assert states == ["stopped", "stopped", "running"]


def test_a_child_that_must_not_finish_is_restarted(tmp_path: Path) -> None:
    router = child("router", "", 3, may_finish=False)
    with supervisor(tmp_path, router, child("actor", SLEEP)) as running:
        wait_until(lambda: status(running, "router").restarts >= 1, 20, "a restart")


def test_children_stop_in_stages(tmp_path: Path) -> None:
    order = tmp_path / "order"

    def source(name: str) -> str:
        return f"""
import pathlib, signal, sys
def stop(*_):
    with open({str(order)!r}, "a") as file: file.write("{name}\\n")
    sys.exit(0)
signal.signal(signal.SIGTERM, stop)
pathlib.Path({str(tmp_path)!r}, "{name}.ready").touch()
signal.pause()
"""

    names = ["driver", "actor", "replay", "router"]
    specs = [child(name, source(name), stage) for stage, name in enumerate(names)]
    with supervisor(tmp_path, *reversed(specs)):
        ready = [tmp_path / f"{name}.ready" for name in names]
        wait_until(lambda: all(file.exists() for file in ready), 20, "all children")
    assert order.read_text().split() == names


def test_stubborn_children_are_gone_within_five_seconds(tmp_path: Path) -> None:
    specs = [child(str(stage), f"print('up', flush=True)\n{STUBBORN}", stage) for stage in range(4)]
    with supervisor(tmp_path, *specs) as running:
        outputs = [tmp_path / f"{stage}.out" for stage in range(4)]
        wait_until(lambda: all(o.stat().st_size for o in outputs), 20, "all children")
        pids = running.pids().values()
        start_s = time.monotonic()
    assert time.monotonic() - start_s < 5.0
    assert not any(exists(pid) for pid in pids)


# ---------------------------------------------------------------- the whole of `corridor up`


@contextmanager
def up(
    folder: Path, *sources: str, output: int = subprocess.PIPE
) -> Iterator[subprocess.Popen[str]]:
    """`corridor up` with fake children that each write `<number>.pid`; killed at the end."""
    script = Path(__file__).with_name("up_with_fakes.py")
    marked = [
        f"import os, pathlib; pathlib.Path({str(folder / f'{number}.pid')!r})"
        f".write_text(str(os.getpid()))\n{source}"
        for number, source in enumerate(sources)
    ]
    with subprocess.Popen(
        [sys.executable, str(script), str(folder), *marked],
        stdout=output,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def fake_pids(folder: Path, count: int) -> list[int]:
    """Process ids of the fake children, once all have written them."""
    files = [folder / f"{number}.pid" for number in range(count)]
    wait_until(lambda: all(f.exists() and f.read_text() for f in files), 20, "all children")
    return [int(file.read_text()) for file in files]


def family(process: subprocess.Popen[str]) -> list[int]:
    """All children of a process."""
    path = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    return [int(pid) for pid in path.read_text().split()]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_everything_within_five_seconds(
    tmp_path: Path, number: signal.Signals
) -> None:
    with up(tmp_path, SLEEP, SLEEP, STUBBORN) as process:
        fake_pids(tmp_path, 3)
        children = family(process)
        assert len(children) == 5  # with router and page
        endpoint = (tmp_path / "endpoint").read_text()
        assert endpoint.startswith("tcp/127.0.0.1:")
        process.send_signal(number)
        start_s = time.monotonic()
        output, errors = process.communicate(timeout=20)
        assert time.monotonic() - start_s < 5.0
    assert process.returncode == 0, errors
    assert "all stopped" in output
    assert not any(exists(pid) for pid in children)
    assert not is_up(tmp_path)
    assert not (tmp_path / "endpoint").exists()


def test_output_that_nobody_reads_stops_neither_supervision_nor_the_end(tmp_path: Path) -> None:
    with full_pipe() as write, up(tmp_path, SLEEP, output=write) as process:
        (pid,) = fake_pids(tmp_path, 1)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: fake_pids(tmp_path, 1) != [pid], 20, "a restart")
        children = family(process)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    assert not any(exists(pid) for pid in children)


def test_nothing_is_left_after_kill_9(tmp_path: Path) -> None:
    with up(tmp_path, SLEEP, STUBBORN) as process:
        fake_pids(tmp_path, 2)
        children = family(process)
        assert len(children) == 4  # with the page
        process.kill()
        wait_until(lambda: not any(exists(pid) for pid in children), 20, "the end of all children")
    assert not is_up(tmp_path)


def test_an_orphaned_run_still_counts_as_up(tmp_path: Path) -> None:
    with up(tmp_path, STUBBORN) as process:
        (pid,) = fake_pids(tmp_path, 1)
        os.kill(pid, signal.SIGSTOP)
        process.kill()
        process.wait()
        assert is_up(tmp_path)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not is_up(tmp_path), 20, "the lock to be free")


def test_a_final_error_of_a_child_is_the_exit_code_of_up(tmp_path: Path) -> None:
    with up(tmp_path, SLEEP, "import sys; sys.stderr.write('disk is foreign'); sys.exit(3)") as p:
        _, errors = p.communicate(timeout=30)
    assert p.returncode == 3
    assert "fake1: disk is foreign" in errors
    assert errors.count("\n") == 1


def test_one_folder_takes_one_up(tmp_path: Path) -> None:
    with up(tmp_path, SLEEP) as process:
        fake_pids(tmp_path, 1)
        message = f"in use by `corridor up`, process {process.pid}"
        with pytest.raises(ConfigError, match=message), locked(tmp_path):
            pass
