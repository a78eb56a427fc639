"""`corridor up` with other children in place of the services: run as a script by the tests.

Arguments: run folder, then Python sources of the children. Each child is tethered like a service.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from services.launcher import up
from services.launcher.supervisor import ChildSpec
from shared.config import Config

TETHERED = "from services.launcher.tether import tether; tether()\n"


def main() -> int:
    folder, *sources = sys.argv[1:]
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
    real_specs = up.child_specs

    def with_fakes(
        config: Config, stored: Config, folder: Path, own: str | None
    ) -> list[ChildSpec]:
        specs = [spec for spec in real_specs(config, stored, folder, own) if spec.name == "router"]
        for number, source in enumerate(sources):
            command = (sys.executable, "-c", TETHERED + source)
            specs.append(ChildSpec(f"fake{number}", command, stage=min(number, 2)))
        return specs

    up.child_specs = with_fakes
    return up.run_all(Config(), Path(folder), listen=None, given=False)


if __name__ == "__main__":
    sys.exit(main())
