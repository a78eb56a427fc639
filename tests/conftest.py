"""What system and contract tests share: a real router of their own and unique run names."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from benchmarks.waiting import wait_until

__all__ = ["wait_until"]

_run_numbers = itertools.count()


@pytest.fixture(scope="session")
def router() -> Iterator[str]:
    """Endpoint of a router that runs in a process of its own for the whole test session.

    It chooses a free port itself and ends when its standard input closes, so that nothing is left
    running whatever happens to the tests.
    """
    command = [sys.executable, "-m", "services.cli", "router", "--tethered"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}
    with subprocess.Popen(
        [*command, "--listen", "tcp/127.0.0.1:0"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        endpoint = process.stdout.readline().strip()
        assert endpoint.startswith("tcp/127.0.0.1:"), f"the router did not start: {endpoint!r}"
        yield endpoint
        process.stdin.close()
        assert process.wait(10) == 0


@pytest.fixture
def run_name() -> str:
    """A run name no other test of this session uses: tests share the router, never a key."""
    return f"test-{os.getpid()}-{next(_run_numbers)}"
