"""Run the benchmarks one after the other and write what they found.

    python -m benchmarks.run_all --short               all but the long ones, in minutes
    python -m benchmarks.run_all training_step         this one; other results stay as they are

Writes results.json and results.md beside this file and renews the table in docs/performance.md.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.frame import Bar, bar_row, from_json, table
from benchmarks.peers import NOT_INSTALLED
from shared.provenance import ROOT, machine

HERE = Path(__file__).parent
RESULTS, PAGE = HERE / "results.json", ROOT / "docs" / "performance.md"
NOTHING = "Nothing measured yet."
Entry = dict[str, Any]
"""What running one script gave: command, mode, when, seconds, machine, error, bars."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Run the benchmarks, write results and tables.")
    parser.add_argument("names", nargs="*", help="scripts to run; none: all")
    parser.add_argument("--short", action="store_true", help="fewer rounds and images")
    given = parser.parse_args(arguments)
    known = scripts()
    for name in given.names:
        if name not in known:
            parser.error(f"no benchmark {name!r}, there are: {', '.join(known)}")
    chosen = [name for name in given.names or known if not (given.short and is_long(name))]
    entries = stored(RESULTS)
    failed = []
    for name in chosen:
        entry = run(name, short=given.short)
        if entry is None:
            continue
        entries[name] = entry
        write({name: entries[name] for name in known if name in entries})
        failed += [name] if entry["error"] else []
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


def scripts() -> list[str]:
    """Names of all scripts, in the order of their bars: the docstring begins with `P<number>:`."""
    found = []
    for path in HERE.glob("*.py"):
        text = path.read_text()
        number = re.match(r"P(\d+)", ast.get_docstring(ast.parse(text)) or "")
        if number and "\ndef main(" in text:
            found.append((int(number[1]), path.stem))
    return [name for _, name in sorted(found)]


def is_long(name: str) -> bool:
    """Whether a script says that it has no short mode; what it found before is kept then."""
    return "\nLONG = True\n" in (HERE / f"{name}.py").read_text()


def run(name: str, *, short: bool) -> Entry | None:
    """Run one script in a process of its own, showing what it prints.

    None when it says that what it compares with is not installed: what it found before is kept.
    """
    words = ["-m", f"benchmarks.{name}", *(["--short"] if short else [])]
    entry: Entry = {
        "command": " ".join(["python", *words]),
        "mode": "short" if short else "full",
        "when": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "machine": machine(),
    }
    start_s = time.perf_counter()
    lines = []
    with subprocess.Popen(
        [sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    if process.returncode == NOT_INSTALLED:
        return None
    entry["seconds"] = round(time.perf_counter() - start_s, 1)
    entry["error"] = f"exit code {process.returncode}" if process.returncode else ""
    entry["bars"] = json.loads(lines[-1]) if lines and not process.returncode else []
    if isinstance(entry["bars"], dict):
        entry["bars"] = [entry["bars"]]
    return entry


def stored(path: Path) -> dict[str, Entry]:
    """Results of earlier runs, by script."""
    return dict(json.loads(path.read_text())) if path.exists() else {}


def write(entries: dict[str, Entry]) -> None:
    """Write results.json and results.md and renew the page."""
    RESULTS.write_text(json.dumps(entries, indent=1) + "\n")
    text = rendered(entries)
    RESULTS.with_suffix(".md").write_text(f"# Results\n\n{text}\n")
    if PAGE.exists():
        PAGE.write_text(renewed(PAGE.read_text(), text))


def renewed(page: str, text: str, mark: str = "measured") -> str:
    """A page with this text between its marks."""
    between = re.compile(rf"(<!-- {mark} -->\n).*?(<!-- end -->)", re.DOTALL)
    return between.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", page)


def rendered(entries: dict[str, Entry]) -> str:
    """One table of all bars, and one of how each script was run."""
    if not entries:
        return NOTHING
    bars: list[Bar] = [from_json(tree) for entry in entries.values() for tree in entry["bars"]]
    runs = [_run_row(name, entry) for name, entry in entries.items()]
    head = ["id", "value", "unit", "required", "aim", "verdict", "plain", "ours", "n", "checks"]
    run_head = ["script", "bars", "command", "mode", "when", "s", "commit", "machine"]
    return f"{table(head, [bar_row(bar) for bar in bars])}\n\n{table(run_head, runs)}"


def _run_row(name: str, entry: Entry) -> list[object]:
    found = ", ".join(bar["id"] for bar in entry["bars"]) or entry["error"]
    what = dict(entry["machine"])
    commit = what.pop("commit")
    described = f"{what.pop('cpu')}, " + ", ".join(f"{k} {v}" for k, v in what.items())
    return [
        name, found, f"`{entry['command']}`", entry["mode"], entry["when"], entry["seconds"],
        commit, described,
    ]  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
