"""Does the page work in a browser? Installs Debian's Chromium where it is missing, and tries it.

    python -m tests.page.trial [options of pytest]

Where there can be no browser, one line says so, and nothing was tried.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def main(arguments: list[str]) -> int:
    """Run the suite; its exit code."""
    from tests.page.rig import installed

    if problem := installed():
        print(f"page-test: NOT RUN, for want of a browser: {problem}")
        return 0
    suite = str(Path(__file__).with_name("suite.py"))
    command = [sys.executable, "-m", "pytest", "-q", "-s", suite, *arguments]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
