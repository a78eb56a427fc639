"""Where `corridor` begins: an emergency stop leaves before anything else is imported."""

import sys


def main() -> int:
    """Run the command line."""
    first = None
    try:
        if sys.argv[1:] == ["--version"]:
            from shared.provenance import version_of

            sys.stdout.write(f"corridor {version_of('corridor')}\n")
            return 0
        if sys.argv[1:2] == ["estop"]:
            from services.cli import first_stop

            first = first_stop.send(sys.argv[2:])
        from services.cli.main import main as rest

        return rest(first_halt=first.number if first else None)
    except KeyboardInterrupt:
        return 130  # nothing was begun that could have ended cleanly
    finally:
        if first is not None:
            first.close()
