"""The list of mutants fits the code, and what judges them tells the caught from the others."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.mutate import ROOT, Mutant, judged, read

MUTANTS = read()
PACKAGES = (
    "shared",
    "shared/rl",
    "shared/rl/retention",
    "services/actor",
    "services/replay",
    "services/learner",
    "services/robot_driver",
    "services/robot_driver/real",
    "services/robot_driver/emulation",
    "services/robot_driver/simulated",
    "services/robot_driver/atlas",
    "services/commander",
    "services/monitor",
    "services/launcher",
    "services/page",
    "services/recorder",
    "services/router",
    "services/security",
    "services/cli",
    "experiments/plans",
    "experiments/runs",
    "experiments/drives",
    "experiments/report",
)


@pytest.mark.parametrize("mutant", MUTANTS, ids=str)
def test_it_changes_one_place_and_its_tests_exist(mutant: Mutant) -> None:
    assert (ROOT / mutant.file).read_text("utf-8").count(mutant.old) == 1
    assert mutant.new != mutant.old
    assert mutant.tests
    for test in mutant.tests:
        path, _, name = test.partition("::")
        text = (ROOT / path).read_text("utf-8")
        assert not name or re.search(rf"^def {re.escape(name)}\(", text, re.MULTILINE), test


def test_there_are_enough_and_no_two_are_alike() -> None:
    assert len(MUTANTS) >= 70
    assert len({(mutant.file, mutant.old, mutant.new) for mutant in MUTANTS}) == len(MUTANTS)
    assert len({str(mutant) for mutant in MUTANTS}) == len(MUTANTS)


def test_every_package_has_one() -> None:
    assert set(PACKAGES) <= {str(Path(mutant.file).parent) for mutant in MUTANTS}


@pytest.mark.parametrize(
    ("test", "verdict"),
    [
        ("from m import one\ndef test_it():\n    assert one() == 1", "caught"),
        ("from m import one\ndef test_it():\n    assert one() > 0", "SURVIVED"),
        ("import there_is_none", "tests do not run (exit code 2 of pytest)"),
    ],
)
def test_a_mutant_is_caught_only_by_a_test_that_fails(
    test: str, verdict: str, tmp_path: Path
) -> None:
    sound = "def one():\n    return 1\n"
    (tmp_path / "m.py").write_text(sound)
    (tmp_path / "test_m.py").write_text(f"{test}\n")
    mutant = Mutant("m.py", "one is two", "return 1", "return 2", ("test_m.py",))
    assert judged(mutant, tmp_path) == verdict
    assert (tmp_path / "m.py").read_text() == sound


def test_a_mutant_that_fits_nowhere_or_twice_is_told(tmp_path: Path) -> None:
    (tmp_path / "m.py").write_text("1 + 1\n")
    for old in ("1", "2"):
        mutant = Mutant("m.py", "nothing", old, "3", ("test_m.py",))
        assert "exactly once" in judged(mutant, tmp_path)
