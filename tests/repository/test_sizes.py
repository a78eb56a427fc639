"""No function and no file grows beyond what one look takes in."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCES = ("shared", "services", "experiments")
LONGEST_FUNCTION = 40
"""Lines, docstring and signature included."""
LONGEST_FILE = 350
TABLES = {"shared/messages.py", "shared/config.py"}
"""Tables: longer on purpose, one row after the other."""
CROWDED = {"shared": 24, "shared/rl": 21}
"""One subject a file, named by it: one look still finds the right one among so many."""
MOST_FILES = 15


def sources() -> Iterator[Path]:
    for name in SOURCES:
        yield from sorted((ROOT / name).rglob("*.py"))


def functions(path: Path) -> Iterator[tuple[str, int]]:
    """Names of all functions of a file with their lengths."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.name, node.end_lineno - node.lineno + 1


def test_functions_are_short() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{name} has {lines} lines"
        for path in sources()
        for name, lines in functions(path)
        if lines > LONGEST_FUNCTION
    ]
    assert long == []


def test_files_are_short() -> None:
    long = {
        f"{path.relative_to(ROOT)} has {lines} lines"
        for path in sources()
        if str(path.relative_to(ROOT)) not in TABLES
        and (lines := len(path.read_text().splitlines())) > LONGEST_FILE
    }
    assert long == set()


def test_folders_are_not_crowded() -> None:
    counts = Counter(
        str(path.parent.relative_to(ROOT)) for path in sources() if path.name != "__init__.py"
    )
    crowded = {
        folder: count for folder, count in counts.items() if count > CROWDED.get(folder, MOST_FILES)
    }
    assert crowded == {}
