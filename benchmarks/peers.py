"""Other projects that benchmarks compare with: optional, installed by `make bench-peers`."""

from __future__ import annotations

import importlib.util
from pathlib import Path

NOT_INSTALLED = 69
"""Exit code of a script whose peers, or whose GPU, are missing: its earlier results stay."""


def require(script: str, *modules: str) -> None:
    """Say in one line which of these modules are not installed, and exit, if any is missing."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        name = Path(script).stem
        print(f"{name}: not measured, {', '.join(missing)} not installed: make bench-peers")
        raise SystemExit(NOT_INSTALLED)
