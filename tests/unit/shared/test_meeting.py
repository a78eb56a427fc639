"""Services work together only if they speak one protocol and have one configuration."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, get_args

import pytest

from shared.config import DRIVER_ONLY, BusConfig, Config, Section
from shared.errors import ConfigError, PeerRefused
from shared.keys import Peer
from shared.messages import PROTOCOL_VERSION
from shared.service import Service, StopFlag
from shared.settings import keys

LIFE = "0" * 12
MAY_DIFFER = ("bus.", "run.episodes", "run.robots", *(f"robot.{key}" for key in DRIVER_ONLY))
FINGERPRINT = Config().fingerprint()


def meet(peer: Peer) -> list[tuple[Any, ...]]:
    """What a new actor announces beside this peer."""
    announced: list[tuple[Any, ...]] = []
    bus: Any = SimpleNamespace(
        run="demo",
        inbox=lambda: SimpleNamespace(serve=lambda *_: None),
        config=BusConfig(),
        peers=lambda *role: [] if role else [peer],
        claims=lambda *_: set(),
        claiming=lambda *_: nullcontext(),
        announce=lambda *told: announced.append(told),
    )
    try:
        Service("actor", "main", LIFE, Config(), bus, StopFlag()).meet()
    except ConfigError:
        assert not announced
        raise
    return announced


def test_a_service_joins_its_like() -> None:
    peer = Peer("replay", "main", LIFE, str(PROTOCOL_VERSION), FINGERPRINT)
    assert meet(peer) == [("actor", "main", LIFE, PROTOCOL_VERSION, FINGERPRINT)]


@pytest.mark.parametrize(
    ("protocol", "config", "told"),
    [
        (str(PROTOCOL_VERSION + 1), FINGERPRINT, "replay 'main' of run 'demo' speaks"),
        (str(PROTOCOL_VERSION), "0" * 16, "replay 'main' of run 'demo' has 0000"),
    ],
)
def test_a_service_that_differs_does_not_join(protocol: str, config: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        meet(Peer("replay", "main", LIFE, protocol, config))


def test_every_setting_but_those_of_one_service_alone_is_part_of_the_fingerprint() -> None:
    for key, field in keys():
        if get_args(field.annotation) == ("torch",):
            continue  # there is no other value
        same = changed(Config(), key.split(".")).fingerprint() == FINGERPRINT
        assert same == key.startswith(MAY_DIFFER), key


def changed(section: Section, path: list[str]) -> Any:
    """The section with another value of a setting."""
    name, *rest = path
    value = getattr(section, name)
    choices = get_args(type(section).model_fields[name].annotation)
    if rest:
        other = changed(value, rest)
    elif isinstance(value, tuple):
        other = (*value, "x")
    elif choices:
        other = next(choice for choice in choices if choice != value)
    else:
        other = f"{value}x" if isinstance(value, str) else type(value)(not value)
    return section.model_copy(update={name: other})


@pytest.mark.parametrize(("refusals", "attempts"), [(0, 6), (3, 3)])
def test_a_request_is_repeated_until_it_was_refused_for_good_so_often(
    refusals: int, attempts: int
) -> None:
    bus: Any = SimpleNamespace(inbox=lambda: None)
    me, tried = Service("actor", "main", LIFE, Config(), bus, StopFlag()), []

    def attempt() -> str:
        tried.append(1)
        if len(tried) < 6:
            raise PeerRefused("no", final=True)
        return "done"

    if refusals:
        with pytest.raises(PeerRefused):
            me.insist("ask", attempt, refusals=refusals)
    else:
        assert me.insist("ask", attempt) == "done"
    assert len(tried) == attempts
