"""What a driver needs of the process it runs in; the driver itself knows no bus and no disk."""

from typing import Any


class Host:
    """The surroundings of a driver. This one, for loops without a service, has none."""

    @property
    def stopping(self) -> bool:
        """Whether the process is to stop: in real time a recovery is broken off then."""
        return False

    def look(self) -> None:
        """Take up commands; called again and again while the robot recovers."""

    def tell(self, line: str) -> None:
        """Log what became of a change of the world."""

    def complain(self, line: str) -> None:
        """Log that a change of the world was refused; of many, some."""
        self.tell(line)

    def keep(self, kept: dict[str, Any]) -> None:
        """Save what must outlive a kill, before a change of the world is acknowledged."""
