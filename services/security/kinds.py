"""The kinds of credentials and what their names mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from shared.errors import ConfigError, not_among
from shared.facts import NAME

if TYPE_CHECKING:
    from shared.keys import Role

ANY = "*"
"""Every run, every robot."""
LONGEST = 50
"""Characters of a name: certificates have room for little more."""


@dataclass(frozen=True)
class Kind:
    """One kind of credential."""

    roles: tuple[Role, ...]
    services: tuple[str, ...]
    """As what it may announce itself."""
    names: Literal["none", "one robot", "robots", "a person"]
    """What its names mean. Without a robot named, `robots` means all."""


KINDS = {
    "driver": Kind(("driver",), ("driver",), "one robot"),
    "actor": Kind(("actor",), ("actor",), "robots"),
    "replay": Kind(("replay",), ("replay",), "none"),
    "learner": Kind(("learner",), ("learner",), "none"),
    "operator": Kind(("operator",), ("recorder",), "a person"),
    "watcher": Kind(("watcher",), ("recorder",), "a person"),
    "pilot": Kind(("operator", "actor"), ("actor",), "robots"),
}
"""A pilot is an operator who also drives: `corridor drive` and `corridor teleop`."""


@dataclass(frozen=True)
class Credential:
    """Who holds a certificate. Its name is the certificate's common name and its folder."""

    kind: str
    names: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Such as `replay`, `driver-alpha` or `actor-alpha.beta`."""
        return "-".join([self.kind, *([".".join(self.names)] if self.names else [])])

    @property
    def idents(self) -> tuple[str, ...]:
        """Ids that are its own: robots, or `main`."""
        meaning = KINDS[self.kind].names
        return (self.names or (ANY,)) if "robot" in meaning else ("main",)


def check(credential: Credential) -> None:
    """Raise ConfigError for a credential that makes no sense."""
    if credential.kind not in KINDS:
        raise not_among("role", credential.kind, KINDS)
    meaning, count = KINDS[credential.kind].names, len(credential.names)
    fits = {"none": count == 0, "one robot": count == 1, "a person": count <= 1, "robots": True}
    if not fits[meaning]:
        raise ConfigError(f"{credential.kind}: expected {meaning} as names, got {count}")
    if len(credential.name) > LONGEST:
        raise ConfigError(f"{credential.kind}: expected names of {LONGEST} characters together")
    for name in credential.names:
        if not NAME.fullmatch(name):
            raise ConfigError(f"{credential.kind}: expected a name like {NAME.pattern}: {name!r}")
