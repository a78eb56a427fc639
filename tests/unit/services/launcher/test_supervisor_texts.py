"""Choosing the line that tells why a process ended."""

from __future__ import annotations

import pytest

from services.launcher.supervisor import verdict

TRACEBACK = """2026-01-01 10:00:00,123 actor ERROR actor crashed
Traceback (most recent call last):
  File "x.py", line 3, in act
    Action(greedy=value)
pydantic_core.ValidationError: 1 validation error for Action
greedy
  Input should be a valid boolean
    For further information visit the documentation
"""
CHAINED = """Traceback (most recent call last):
  File "x.py", line 3, in read
KeyError: 'a'

The above exception was the direct cause of the following exception:

Traceback (most recent call last):
  File "x.py", line 5, in load
    raise ValueError
ValueError: no a
"""


@pytest.mark.parametrize(
    ("output", "line"),
    [
        ("", ""),
        ("\n\n", ""),
        ("one\ntwo\n", "two"),
        ("2026-01-01 10:00:00,123 replay ERROR memory is damaged\n", "memory is damaged"),
        ("corridor: memory.capacity: expected more\n", "memory.capacity: expected more"),
        (CHAINED, "ValueError: no a"),
        (CHAINED + "2026-01-01 10:00:00,123 replay INFO bye\n", "ValueError: no a"),
        (TRACEBACK, "pydantic_core.ValidationError: 1 validation error for Action"),
    ],
)
def test_verdict(output: str, line: str) -> None:
    assert verdict(output) == line
