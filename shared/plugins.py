"""What other packages add by entry points; they are looked at only where a name is not ours.

A package names its additions in its own `pyproject.toml`, by group and name (docs/extending.md).
"""

from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from pydantic_core import PydanticCustomError

ROBOTS, POLICIES, RETENTION, WORLDS, TRACKERS = (
    f"corridor.{what}" for what in ("robots", "policies", "retention", "worlds", "trackers")
)
"""Groups of entry points."""


def names(group: str) -> list[str]:
    """What is added in a group."""
    return sorted(entry_points(group=group).names)


@cache
def load(group: str, name: str) -> Any:
    """What a package added under this name. Raises KeyError: nothing."""
    found = entry_points(group=group, name=name)
    if not found:
        raise KeyError(name)
    return next(iter(found)).load()


@dataclass(frozen=True)
class OneOf:
    """Checks a setting: one of our names, or one that a package added."""

    group: str
    ours: tuple[str, ...]

    def __call__(self, name: str) -> str:
        """Return the name. Raises PydanticCustomError for another one."""
        if name not in self.ours and name not in (added := names(self.group)):
            *others, last = (f"'{each}'" for each in (*self.ours, *added))
            expected = f"{', '.join(others)} or {last}"
            raise PydanticCustomError("one_of", "{expected}", {"expected": expected})
        return name
