"""No file but `shared/facts.py` states the image size, the actions or the pattern of names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from shared import facts

ROOT = Path(__file__).parents[2]
FILES = sorted(
    path
    for package in ("shared", "services", "experiments", "benchmarks")
    for path in (ROOT / package).rglob("*.py")
    if path != ROOT / "shared" / "facts.py"
)
HEIGHT, WIDTH = facts.IMAGE_SHAPE
SIZE = re.compile(
    rf"\b({HEIGHT}, *{WIDTH}|{WIDTH}, *{HEIGHT}|{WIDTH}x{HEIGHT}|{facts.IMAGE_BYTES})\b"
)
SHAPE_NOTE = re.compile(r"uint8 \[|\[n, ")
"""Marks a line that tells the shape of an array to its reader."""
NAMES = facts.NAME.pattern.strip("^$")
SEQUENCES: tuple[list[object], ...] = (
    [action.name for action in facts.ACTIONS],
    [action.short for action in facts.ACTIONS],
    [action.vector for action in facts.ACTIONS],
    [action.turn for action in facts.ACTIONS],
    [action.mirror for action in facts.ACTIONS],
)
"""One property of all actions each, in their order."""


def value(node: ast.expr) -> object:
    """The value of a literal, lists as tuples; the node itself where it is no literal."""
    if isinstance(node, ast.List | ast.Tuple):
        return tuple(value(element) for element in node.elts)
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        return node


def contains(whole: Sequence[object], part: Sequence[object]) -> bool:
    ends = range(len(part), len(whole) + 1)
    return any(list(whole[end - len(part) : end]) == list(part) for end in ends)


def restated(source: str) -> Iterator[str]:
    """Every restatement of a fact in a file, with its line."""
    for number, line in enumerate(source.splitlines(), 1):
        if SIZE.search(line) and not SHAPE_NOTE.search(line):
            yield f"{number}: image size"
        if NAMES in line:
            yield f"{number}: pattern of names"
        if any("/" in action.name and action.name in line for action in facts.ACTIONS):
            yield f"{number}: name of an action"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.List | ast.Tuple | ast.Set):
            elements = [value(element) for element in node.elts]
        elif isinstance(node, ast.Dict):
            elements = [value(key) for key in node.keys if key is not None]
        else:
            continue
        if any(contains(elements, sequence) for sequence in SEQUENCES):
            yield f"{node.lineno}: actions"


def test_no_fact_is_restated() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{what}" for path in FILES for what in restated(path.read_text())
    ]
    assert not found


@pytest.mark.parametrize(
    "source",
    [
        f"SIZE = ({HEIGHT}, {WIDTH})",
        f"cv2.resize(frame, ({WIDTH},{HEIGHT}))",
        f"count = {facts.IMAGE_BYTES}",
        f'NAME = r"{facts.NAME.pattern}"',
        f"NAMES = {SEQUENCES[0]}",
        f"COLUMNS = {['bumps', *SEQUENCES[1], 'seconds']}",
        f"COLOURS = {dict.fromkeys(SEQUENCES[1], 0)}",
        f"VECTORS = [{', '.join(str([int(bit) for bit in a.vector]) for a in facts.ACTIONS)}]",
        f"TURNS = {tuple(float(action.turn) for action in facts.ACTIONS)}",
    ],
)
def test_each_kind_of_restatement_is_found(source: str) -> None:
    assert list(restated(source))


@pytest.mark.parametrize(
    "source",
    [
        f'"""uint8 [n, {HEIGHT}, {WIDTH}]."""',
        f'"""Maps of images [n, 1, {HEIGHT}, {WIDTH}]."""',
        f"pixels = {HEIGHT} * {WIDTH + 1}",
        "KEYS = {'w': 'forward', 'left': 'turn-left', 'right': 'turn-right'}",
    ],
)
def test_shape_notes_and_other_numbers_are_none(source: str) -> None:
    assert not list(restated(source))
