"""All errors of our own.

CorridorError
├── ConfigError        wrong configuration or folder: exit code 2, one line, nothing moved yet
├── StateError         what lies on disk does not fit or is damaged: exit code 3
├── DiskFull           no room for a file: what waits for it goes on as soon as there is
├── RoleTaken          another process has this role: exit code 4, one line
├── RobotMissing       no real robot answers (yet): exit code 1, one line
├── BadMessage         bytes that are not a valid message of the expected type
└── BusError
    ├── RouterMissing  no router at the endpoint (yet)
    ├── PeerMissing    nobody serves this request now
    ├── PeerSilent     served, but no complete answer in time
    ├── PeerRefused    answered with an error, final or not; the text is the peer's
    └── RobotTaken     somebody else commands this robot
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from reprlib import repr as brief
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

LONGEST_PLACE = 100
"""Characters of a field name in an error: the sender may have made it up."""


class CorridorError(Exception):
    """Base of all errors this project raises on purpose."""

    exit_code = 1
    """Of the program that it ends."""


class ConfigError(CorridorError):
    """A configuration that cannot work, told in one line: key, expected, got, where from."""

    exit_code = 2


class StateError(CorridorError):
    """State on disk that does not belong to this run or is damaged."""

    exit_code = 3


class DiskFull(CorridorError, OSError):
    """There is no room for a file; whatever was there is as before."""


class RoleTaken(CorridorError):
    """Another process has the role that this one wants; the text names it."""

    exit_code = 4


class RobotMissing(CorridorError):
    """The real robot cannot be reached, or one of its sensors does not answer."""


class BadMessage(CorridorError):
    """Bytes that are not a valid message: says what was expected and what came."""


class BusError(CorridorError):
    """Something between the services."""


class RouterMissing(BusError):
    """No router answers at the endpoint."""


class PeerMissing(BusError):
    """No service answers this request: it is not there, or the router is not."""


class PeerSilent(BusError):
    """The answer did not come, or broke off, before the deadline."""


class PeerRefused(BusError):
    """The peer answered with an error. `final`: the same request will be refused again."""

    def __init__(self, text: str, *, final: bool = False) -> None:
        super().__init__(text)
        self.final = final


class RobotTaken(BusError):
    """Somebody else commands this robot: there is one commander at a time."""


def meant(given: str, known: Iterable[str]) -> str:
    """The known name that a mistyped one is nearest to, as the end of a sentence, or nothing."""
    names = list(known)
    near = [] if given in names else difflib.get_close_matches(given, names, n=1)
    return f", did you mean {near[0]}?" if near else ""


def not_among(what: str, given: str, known: Iterable[str], more: str = "") -> ConfigError:
    """The error that says which names there are; more: what else may stand there."""
    names = list(known)
    text = f"{what}: expected one of {', '.join(names)}{more}, got {given!r}"
    return ConfigError(text + meant(given, names))


def first_problem(error: ValidationError) -> str:
    """The first complaint of a validation, in one line without the (possibly huge) input."""
    problem = error.errors(include_url=False, include_input=False, include_context=False)[0]
    where = ".".join(str(part) for part in problem["loc"])
    if len(where) > LONGEST_PLACE or not where.isprintable():
        where = brief(where)
    text = problem["msg"].removeprefix("Value error, ")
    return f"{where}: {text}" if where else text
