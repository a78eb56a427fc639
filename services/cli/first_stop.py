"""The first message of an emergency stop, sent before the rest of the program is even imported.

Only the standard library, Zenoh and msgpack are needed for it. Whatever is unusual (an option that
is not known here, several runs, no router) is left to `corridor estop` as a whole, which follows in
any case: it sends the same halt, with the same number, until all robots stand.
"""

import os
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgpack
import zenoh

from shared import place
from shared.facts import DEFAULT_ENDPOINT, DEFAULT_RUN, NAME, PROTOCOL_VERSION
from shared.zenoh_settings import zenoh_config

OPTIONS = ("--run", "--run-dir", "--endpoint", "--credentials", "--robot")


@dataclass(frozen=True)
class Target:
    """Who is to stop, and how to reach them."""

    run: str
    endpoint: str
    credentials: str
    robot: str


class FirstStop:
    """A halt that was sent. Its session must be open until the message has left."""

    def __init__(self, number: int, session: zenoh.Session) -> None:
        self.number, self._session = number, session

    def close(self) -> None:
        """End the session, without which the program would not end."""
        self._session.close()  # type: ignore[no-untyped-call]


def send(arguments: Sequence[str]) -> FirstStop | None:
    """Halt the robots that the arguments of `corridor estop` mean; None: it was not sent."""
    target = find(arguments, os.environ)
    if target is None:
        return None
    try:
        session = zenoh.open(
            zenoh_config("client", connect=[target.endpoint], credentials=target.credentials)
        )
    except zenoh.ZError:
        return None
    number = time.time_ns()
    session.get(
        f"{target.run}/halt",
        lambda _: None,
        payload=message(number, target.robot),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )
    return FirstStop(number, session)


def message(number: int, robot: str) -> bytes:
    """A `Halts` message with one emergency stop."""
    halt = {"number": number, "kind": "estop", "robot": robot}
    data: bytes = msgpack.packb({"v": PROTOCOL_VERSION, "t": "Halts", "halts": [halt]})
    return data


def find(arguments: Sequence[str], env: Mapping[str, str]) -> Target | None:
    """Who is meant, if that is plain."""
    chosen = _options(arguments)
    if chosen is None:
        return None
    endpoint = chosen.get("--endpoint") or env.get("CORRIDOR_BUS__ENDPOINT")
    credentials = chosen.get("--credentials") or env.get("CORRIDOR_CREDENTIALS", "")
    run = chosen.get("--run") or env.get("CORRIDOR_RUN__NAME")
    if not endpoint:
        up = [Path(chosen["--run-dir"])] if "--run-dir" in chosen else place.those_up()
        if len(up) > 1 and run:
            up = [folder for folder in up if _name(folder) == run]
        used = place.used(up[0]) if len(up) == 1 else None
        if used is None:
            return None
        endpoint, credentials = used[0], credentials or used[1]
        run = run or _name(up[0])
    target = Target(run or DEFAULT_RUN, endpoint or DEFAULT_ENDPOINT, "", chosen.get("--robot", ""))
    if not NAME.fullmatch(target.run) or (target.robot and not NAME.fullmatch(target.robot)):
        return None
    return Target(target.run, target.endpoint, _certificate(credentials), target.robot)


def _options(arguments: Sequence[str]) -> dict[str, str] | None:
    """Options by name; None if there is anything else."""
    words, chosen = list(arguments), dict[str, str]()
    while words:
        name, equals, value = words.pop(0).partition("=")
        if name not in OPTIONS or (not equals and not words):
            return None
        chosen[name] = value if equals else words.pop(0)
    return chosen


def _name(folder: Path) -> str:
    """Name of the run in a folder, as stored; the default if it is not to be read."""
    try:
        run = tomllib.loads((folder / "config.toml").read_text()).get("run", {})
        return str(run.get("name", DEFAULT_RUN))
    except (OSError, ValueError, AttributeError):
        return DEFAULT_RUN


def _certificate(credentials: str) -> str:
    """The folder with an operator's certificate, in or below the one given."""
    for name in ("", "operator", "pilot"):
        if credentials and (Path(credentials) / name / "cert.pem").exists():
            return str((Path(credentials) / name).absolute())
    return credentials
