"""Style, types and dependencies, beside all other tests."""

from __future__ import annotations

import pytest

from tests.checks import EVERY, check


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", sorted(EVERY, reverse=True))  # types take longest
def test_it_passes(name: str) -> None:
    done = check(name)
    assert done.returncode == 0, done.stdout + done.stderr
