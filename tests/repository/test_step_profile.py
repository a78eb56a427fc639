"""Where a step spends its time: what is read from Linux and how it is added up."""

from __future__ import annotations

from collections import Counter

import pytest

from benchmarks import step_profile


def stat(name: str, user: int, system: int) -> str:
    """A line as in /proc/PID/task/TID/stat."""
    return f"17 ({name}) S 1 17 17 0 -1 4194560 5 0 0 0 {user} {system} 0 0 20 0 8 0 99 1 2\n"


@pytest.mark.parametrize(
    ("name", "main", "kind"),
    [
        ("python", True, "main"), ("python", False, "other"), ("rx-0", False, "zenoh"),
        ("tx-0", False, "zenoh"), ("a) b (c", False, "other"),
    ],
)  # fmt: skip
def test_ticks_of_a_thread_are_those_in_and_out_of_the_kernel(
    name: str, main: bool, kind: str
) -> None:
    assert step_profile.thread_ticks(stat(name, 30, 12), is_main=main) == (kind, 42)


def test_ticks_become_milliseconds_a_step_and_drivers_count_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(step_profile, "TICKS_PER_S", 100)
    used = {
        "actor": Counter(main=50, zenoh=10),
        "driver": Counter(main=20),
        "driver-robotino2": Counter(main=20, other=5),
    }
    text = step_profile.processes_table(used, steps=1000, spent_s=2.0)
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in text.splitlines()[2:5]}
    cells = {name: [cell.strip() for cell in row] for name, row in rows.items()}
    assert cells["actor"] == ["0.5", "0.1", "0", "0.6", "30%"]
    assert cells["driver"] == ["0.4", "0", "0.05", "0.45", "22%"]
    assert cells["all"] == ["0.9", "0.1", "0.05", "1.05", "52%"]
    assert text.endswith("A step every 2.00 ms.")


def test_parts_are_timed_where_they_are() -> None:
    class Thing:
        def work(self, a: int, b: int = 0) -> int:
            return a + b

    thing, spent = Thing(), Counter[str]()
    step_profile.timed(thing, "work", "working", spent)
    assert thing.work(1, b=2) == 3
    assert spent["working"] > 0.0
