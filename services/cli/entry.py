"""Where `corridor` begins: an emergency stop leaves before anything else is imported."""

import sys


def main() -> int:
    """Run the command line."""
    first = None
    if sys.argv[1:2] == ["estop"]:
        from services.cli import first_stop

        first = first_stop.send(sys.argv[2:])
    try:
        from services.cli.main import main as rest

        return rest(first_halt=first.number if first else None)
    finally:
        if first is not None:
            first.close()
