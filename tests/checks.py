"""The checks of style, types and dependencies: one list for `make check` and for the tests.

python -m tests.checks [--style]
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
GENERATED = {"docs/results.md"}
"""Pages that a command writes, in lines of its own."""


def pages() -> list[str]:
    """Pages that are wrapped and formatted, relative to the root."""
    found = ["README.md", "benchmarks/results.md"]
    found += sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md"))
    return [page for page in found if page not in GENERATED]


STYLE = {
    "ruff": ["ruff", "check", "."],
    "format": ["ruff", "format", "--check", "."],
    "pages": ["mdformat", "--check", *pages()],
}
EVERY = {**STYLE, "types": ["mypy"], "imports": ["lint-imports"]}
"""Commands by name; their programs lie beside the interpreter."""


def check(name: str) -> subprocess.CompletedProcess[str]:
    """Run one of them."""
    program, *arguments = EVERY[name]
    command = [str(Path(sys.executable).parent / program), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def main(words: list[str]) -> int:
    """Run all, or those of style; print what fails."""
    failed = 0
    for name in STYLE if "--style" in words else EVERY:
        done = check(name)
        failed += done.returncode != 0
        sys.stdout.write(f"{name}: {'failed' if done.returncode else 'passed'}\n")
        if done.returncode:
            sys.stdout.write(done.stdout + done.stderr)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
